"""Encode columns as messages that Foxglove shows without settings, and decode pictures.

There is one message per frame and topic.

Schemas: Foxglove's own in protobuf (`JointStates`, `RawImage`, `Log`), LeRobot's scalars in JSON.
Numbers and pictures keep every bit. Pictures are stored raw and compressed by the file's zstd,
which exploits the similarity of successive frames: rendered frames of 128 x 128 took a third of a
PNG's bytes and a fifth of its time.
"""

import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any, BinaryIO

import numpy as np
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema
from numpy.typing import NDArray

from manip_il.data import schema as s
from manip_il.mdp import Episode
from manip_il.worlds.contract import EnvironmentSpec

U8 = NDArray[np.uint8]
Times = Sequence[int]  # [ns], one per frame
Messages = Iterator[Message | str]  # one per frame, all of one class; scalars are JSON texts

NANOSECONDS = 1_000_000_000
IMAGE_TOPICS = "/observation/images/"  # prefix of a camera's topic, as in LeRobot
_JOINT_TOPICS = {
    "/joint_states": s.STATE,
    "/action": s.ACTION,
    "/executed_action": s.EXECUTED_ACTION,
}
_SCALARS = (s.ACTOR, s.EXPERT_PHASE, s.LABEL_VALID, s.REWARD, s.SUCCESS, s.DONE)

# copied from LeRobot (`lerobot.utils.foxglove_visualization`)
_SCALARS_NAME = "lerobot.Scalars"
_SCALARS_SCHEMA = (
    b'{"type": "object", "title": "lerobot.Scalars", "properties": {"scalars": {"type": "array",'
    b' "items": {"type": "object", "properties": {"label": {"type": "string"}, "value": {"type":'
    b' "number"}}}}}}'
)


def frame_times(count: int, rate: Fraction) -> list[int]:
    """Return the times of an episode's frames [ns], from 0, at a rate [frames/s]."""
    return [frame * NANOSECONDS * rate.denominator // rate.numerator for frame in range(count)]


def joint_states(names: Sequence[str], values: NDArray[Any], times: Times) -> Messages:
    """Yield one message of joint positions per frame.

    Args:
        names: Names of the n joints.
        values: The positions, (T, n).
        times: Times of the T frames [ns].
    """
    for time, row in zip(times, values.tolist(), strict=True):
        joints = [
            JointState(name=name, position=position)
            for name, position in zip(names, row, strict=True)
        ]
        yield JointStates(timestamp=_stamp(time), joints=joints)


def scalars(labels: Sequence[str], rows: Iterable[Sequence[float]]) -> Messages:
    """Yield one JSON message of labelled numbers per row.

    Args:
        labels: Names of the numbers.
        rows: T rows of Python numbers, which must be finite.
    """
    for row in rows:
        pairs = zip(labels, row, strict=True)
        # + for bools
        yield json.dumps({"scalars": [{"label": label, "value": +value} for label, value in pairs]})


def images(frame_id: str, pictures: Iterable[U8], times: Times) -> Messages:
    """Yield one message per picture, uncompressed.

    Args:
        frame_id: Name of the camera.
        pictures: T RGB pictures, each (height, width, 3).
        times: Times of the T frames [ns].
    """
    for time, picture in zip(times, pictures, strict=True):
        height, width, depth = picture.shape
        yield RawImage(
            timestamp=_stamp(time),
            frame_id=frame_id,
            height=height,
            width=width,
            encoding="rgb8",
            step=width * depth,
            data=picture.tobytes(),
        )


def texts(name: str, lines: Iterable[str], times: Times) -> Messages:
    """Yield one log message per line.

    Args:
        name: The source that the messages name.
        lines: T lines.
        times: Times of the T frames [ns].
    """
    for time, line in zip(times, lines, strict=True):
        yield Log(timestamp=_stamp(time), level=Log.Level.INFO, name=name, message=line)


def _stamp(time: int) -> Timestamp:
    seconds, nanos = divmod(time, NANOSECONDS)
    return Timestamp(seconds=seconds, nanos=nanos)


def episode_channels(episode: Episode, times: Times, spec: EnvironmentSpec) -> dict[str, Messages]:
    """Return the messages of an episode's columns.

    Args:
        episode: The episode, with T frames.
        times: Times of the frames [ns].
        spec: Names the numbers of states and actions.

    Returns:
        Topic -> messages, one per frame.
    """
    columns = episode.columns
    found = {
        topic: joint_states(
            spec.observed_names if key == s.STATE else spec.joint_names, columns[key], times
        )
        for topic, key in _JOINT_TOPICS.items()
        if key in columns
    }
    if numbers := {key: columns[key].reshape(-1) for key in _SCALARS if key in columns}:
        rows = zip(*(column.tolist() for column in numbers.values()), strict=True)
        found["/scalars"] = scalars(list(numbers), rows)
    for key, pictures in columns.items():
        if key.startswith(s.IMAGES):
            camera = key.removeprefix(s.IMAGES)
            found[IMAGE_TOPICS + camera] = images(camera, pictures, times)
    return found


def add_channels(writer: Writer, channels: Mapping[str, Messages], times: Times) -> None:
    """Write all messages to a file, frame by frame.

    Args:
        writer: The open file.
        channels: Topic -> messages, one per frame.
        times: Times of the frames [ns].

    Raises:
        ValueError: if the channels and `times` differ in length.
    """
    schemas: dict[type, int] = {}  # class of messages -> its schema
    ids: dict[str, int] = {}
    for frame, (time, messages) in enumerate(
        zip(times, zip(*channels.values(), strict=True), strict=bool(channels))
    ):
        for topic, message in zip(channels, messages, strict=True):
            kind = type(message)
            if kind not in schemas:
                scalars = _SCALARS_NAME, "jsonschema", _SCALARS_SCHEMA
                schemas[kind] = (
                    writer.register_schema(*scalars)
                    if kind is str
                    else register_schema(writer, kind)
                )
            if topic not in ids:
                ids[topic] = writer.register_channel(
                    topic, "json" if kind is str else "protobuf", schemas[kind]
                )
            data = (
                message.encode()
                if isinstance(message, str)
                else message.SerializeToString(deterministic=True)
            )
            writer.add_message(ids[topic], time, data, time, frame)


def read_images(stream: BinaryIO, cameras: Collection[str]) -> dict[str, U8]:
    """Return the pictures that `images` wrote to a file, (T, height, width, 3), by camera."""
    pictures: dict[str, list[U8]] = {camera: [] for camera in cameras}
    topics = [IMAGE_TOPICS + camera for camera in cameras]
    stream.seek(0)
    if not cameras:
        return {}
    messages = make_reader(stream).iter_messages(topics, log_time_order=False)  # as written
    for _, channel, message in messages:
        image = RawImage.FromString(message.data)
        picture = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
        pictures[channel.topic.removeprefix(IMAGE_TOPICS)].append(picture)
    return {camera: np.stack(taken) for camera, taken in pictures.items()}
