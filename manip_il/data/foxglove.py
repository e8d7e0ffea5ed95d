"""Encode columns as messages that Foxglove shows without settings, and decode pictures.

There is one message per frame and topic.

Schemas: Foxglove's own in protobuf (`JointStates`, `RawImage`, `Log`), LeRobot's scalars in JSON.
Numbers and pictures keep every bit. Pictures are stored raw and compressed by the file's zstd,
which exploits the similarity of successive frames: rendered frames of 128 x 128 took a third of a
PNG's bytes and a fifth of its time.
"""

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from fractions import Fraction
from functools import cache
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
Encode = Callable[[Any, Timestamp], Message | str]  # a frame's value and time -> message, or JSON
Channel = tuple[Encode, Iterable[Any]]  # with one value per frame

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


def joint_states(names: Sequence[str]) -> Encode:
    """Return the encoder of rows of joint positions, (n,) Python numbers, of n named joints."""

    def encode(row: Sequence[float], time: Timestamp) -> Message:
        joints = [
            JointState(name=name, position=position)
            for name, position in zip(names, row, strict=True)
        ]
        return JointStates(timestamp=time, joints=joints)

    return encode


def scalars(labels: Sequence[str]) -> Encode:
    """Return the encoder of rows of labelled Python numbers, which must be finite, as JSON."""

    def encode(row: Sequence[float], time: Timestamp) -> str:
        pairs = zip(labels, row, strict=True)
        # + for bools
        return json.dumps(
            {"scalars": [{"label": label, "value": +value} for label, value in pairs]}
        )

    return encode


def images(frame_id: str) -> Encode:
    """Return the encoder of a camera's RGB pictures, (height, width, 3), uncompressed."""

    def encode(picture: U8, time: Timestamp) -> Message:
        height, width, depth = picture.shape
        return RawImage(
            timestamp=time,
            frame_id=frame_id,
            height=height,
            width=width,
            encoding="rgb8",
            step=width * depth,
            data=picture.tobytes(),
        )

    return encode


def texts(name: str) -> Encode:
    """Return the encoder of lines of text. name: the source that the messages name."""
    return lambda line, time: Log(timestamp=time, level=Log.Level.INFO, name=name, message=line)


def episode_channels(episode: Episode, spec: EnvironmentSpec) -> dict[str, Channel]:
    """Return an episode's columns by topic. spec: names the numbers of states and actions."""
    columns = episode.columns
    found: dict[str, Channel] = {
        topic: (
            joint_states(spec.observed_names if key == s.STATE else spec.joint_names),
            columns[key].tolist(),
        )
        for topic, key in _JOINT_TOPICS.items()
        if key in columns
    }
    if numbers := {key: columns[key].reshape(-1) for key in _SCALARS if key in columns}:
        rows = zip(*(column.tolist() for column in numbers.values()), strict=True)
        found["/scalars"] = scalars(list(numbers)), rows
    for key, pictures in columns.items():
        if key.startswith(s.IMAGES):
            camera = key.removeprefix(s.IMAGES)
            found[IMAGE_TOPICS + camera] = images(camera), pictures
    return found


def add_channels(writer: Writer, channels: Mapping[str, Channel], times: Sequence[int]) -> None:
    """Write all messages to a file, frame by frame.

    Args:
        writer: The open file.
        channels: Topic -> its encoder and T values.
        times: Times of the T frames [ns].

    Raises:
        ValueError: if the channels and `times` differ in length.
    """

    @cache
    def schema_of(kind: type) -> int:
        if kind is str:
            return writer.register_schema(_SCALARS_NAME, "jsonschema", _SCALARS_SCHEMA)
        return register_schema(writer, kind)

    @cache
    def channel_of(topic: str, kind: type) -> int:
        encoding = "json" if kind is str else "protobuf"
        return writer.register_channel(topic, encoding, schema_of(kind))

    rows = zip(times, *(values for _, values in channels.values()), strict=True)
    for frame, (time, *row) in enumerate(rows):
        seconds, nanos = divmod(time, NANOSECONDS)
        stamp = Timestamp(seconds=seconds, nanos=nanos)
        for (topic, (encode, _)), value in zip(channels.items(), row, strict=True):
            message = encode(value, stamp)
            data = (
                message.encode()
                if isinstance(message, str)
                else message.SerializeToString(deterministic=True)
            )
            writer.add_message(channel_of(topic, type(message)), time, data, time, frame)


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
