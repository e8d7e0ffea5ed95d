"""Channels of messages that Foxglove shows without settings, one message per frame, and decoding of their pictures.

Schemas: Foxglove's own in protobuf (`JointStates`, `RawImage`, `Log`), LeRobot's scalars in JSON.
Numbers and pictures keep every bit. Pictures are stored raw and compressed by the file's zstd, which exploits the
similarity of successive frames: rendered frames of 128 x 128 took a third of a PNG's bytes and a fifth of its time.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, Schema
from mcap.records import Message as MessageRecord
from mcap.stream_reader import breakup_chunk
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set
from numpy.typing import NDArray

from manip_il.data import schema as s
from manip_il.mdp import Episode

U8 = NDArray[np.uint8]
Times = Sequence[int]  # [ns], one per frame

NANOSECONDS = 1_000_000_000
IMAGE_TOPICS = "/observation/images/"  # prefix of a camera's name, as in LeRobot
_JOINT_TOPICS = {"/joint_states": s.STATE, "/action": s.ACTION, "/executed_action": s.EXECUTED_ACTION}
_SCALARS = (s.ACTOR, s.EXPERT_PHASE, s.LABEL_VALID, s.REWARD, s.SUCCESS, s.DONE)

# copied from LeRobot (`lerobot.utils.foxglove_visualization`)
_NAMED_NUMBER = {"type": "object", "properties": {"label": {"type": "string"}, "value": {"type": "number"}}}
SCALARS: dict[str, Any] = {
    "type": "object",
    "title": "lerobot.Scalars",
    "properties": {"scalars": {"type": "array", "items": _NAMED_NUMBER}},
}


@dataclass(frozen=True)
class Channel:
    """One topic. schema: its id is set by the writer; messages: encoded, one per frame, an iterator."""

    topic: str
    schema: Schema
    messages: Iterator[bytes]


def frame_times(episode: Episode, spec: s.RobotTaskSpec) -> list[int]:
    """Return every frame's log time [ns]."""
    return [frame * NANOSECONDS // spec.fps for frame in range(len(episode))]


def joint_states(topic: str, names: Sequence[str], values: NDArray[Any], times: Times) -> Channel:
    """Make a channel of positions (T, n) of named joints."""
    message = JointStates()
    joints = [message.joints.add(name=name) for name in names]

    def fill(row: list[float]) -> None:
        for joint, value in zip(joints, row, strict=True):
            joint.position = value

    return _protobuf_channel(topic, message, message.timestamp, times, values.tolist(), fill)


def scalars(topic: str, labels: Sequence[str], rows: Iterable[Sequence[float]]) -> Channel:
    """Make a channel of labelled numbers. rows: T rows of finite Python numbers, because JSON has no others."""
    # filling a template is five times as fast as encoding a dict
    slots = (f'{{"label":{json.dumps(label).replace("%", "%%")},"value":%r}}' for label in labels)
    template = f'{{"scalars":[{",".join(slots)}]}}'
    schema = Schema(data=json.dumps(SCALARS).encode(), encoding="jsonschema", id=0, name=SCALARS["title"])
    return Channel(topic, schema, ((template % tuple(row)).encode() for row in rows))


def images(topic: str, frame_id: str, pictures: Iterable[U8], times: Times) -> Channel:
    """Make a lossless channel of RGB pictures (height, width, 3)."""
    message = RawImage(frame_id=frame_id, encoding="rgb8")

    def fill(picture: U8) -> None:
        message.height, message.width, depth = picture.shape
        message.step = message.width * depth
        message.data = picture.tobytes()

    return _protobuf_channel(topic, message, message.timestamp, times, pictures, fill)


def texts(topic: str, name: str, lines: Iterable[str], times: Times) -> Channel:
    """Make a channel of log messages from `name`."""
    message = Log(level=Log.Level.INFO, name=name)

    def fill(line: str) -> None:
        message.message = line

    return _protobuf_channel(topic, message, message.timestamp, times, lines, fill)


def episode_channels(episode: Episode, spec: s.RobotTaskSpec) -> Iterator[Channel]:
    """Yield a channel for each of the episode's columns that has one."""
    times, columns = frame_times(episode, spec), episode.columns
    for topic, key in _JOINT_TOPICS.items():
        if key in columns:
            yield joint_states(topic, spec.joint_names, columns[key], times)
    if numbers := {key: columns[key].reshape(-1) for key in _SCALARS if key in columns}:
        lists = [(one.astype(np.int64) if one.dtype.kind == "b" else one).tolist() for one in numbers.values()]
        yield scalars("/scalars", list(numbers), zip(*lists, strict=True))
    for key, pictures in columns.items():
        if key.startswith(s.IMAGES):
            camera = key.removeprefix(s.IMAGES)
            yield images(IMAGE_TOPICS + camera, camera, pictures, times)


def add_channels(writer: Writer, channels: Sequence[Channel], times: Times) -> None:
    """Write all messages, frame by frame."""
    schema_ids: dict[str, int] = {}
    channel_ids: list[int] = []
    for channel in channels:
        schema = channel.schema
        if schema.name not in schema_ids:
            schema_ids[schema.name] = writer.register_schema(schema.name, schema.encoding, schema.data)
        encoding = "json" if schema.encoding == "jsonschema" else schema.encoding
        channel_ids.append(writer.register_channel(channel.topic, encoding, schema_ids[schema.name]))
    frames = zip(*(channel.messages for channel in channels), strict=True)
    for frame, (time, messages) in enumerate(zip(times, frames, strict=bool(channels))):
        for channel_id, message in zip(channel_ids, messages, strict=True):
            writer.add_message(channel_id, time, message, time, frame)


def read_images(chunks: Iterable[Chunk], shape: tuple[int, ...]) -> dict[str, U8]:
    """Return the pictures that `images` wrote, by camera; a camera without pictures is left out.

    chunks: of a file, in order. shape: of each camera's pictures, (T, height, width, 3).
    """
    pictures: dict[str, U8] = {}
    cameras: dict[int, str] = {}  # by the id of their channel
    for record in (record for chunk in chunks for record in breakup_chunk(chunk)):
        if isinstance(record, ChannelRecord) and record.topic.startswith(IMAGE_TOPICS):
            cameras[record.id] = record.topic.removeprefix(IMAGE_TOPICS)
        elif isinstance(record, MessageRecord) and record.channel_id in cameras:
            camera = cameras[record.channel_id]
            if camera not in pictures:
                pictures[camera] = np.empty(shape, np.uint8)
            data = RawImage.FromString(record.data).data
            pictures[camera][record.sequence] = np.frombuffer(data, np.uint8).reshape(shape[1:])
    return pictures


def _protobuf_channel[Row](
    topic: str,
    message: Message,
    stamp: Timestamp,
    times: Times,
    rows: Iterable[Row],
    fill: Callable[[Row], None],
) -> Channel:
    """Make a channel with one message per row, stamped and filled from the row."""

    def messages() -> Iterator[bytes]:
        for time, row in zip(times, rows, strict=True):
            stamp.seconds, stamp.nanos = divmod(time, NANOSECONDS)
            fill(row)
            yield message.SerializeToString(deterministic=True)

    return Channel(topic, _protobuf_schema(type(message)), messages())


@functools.cache
def _protobuf_schema(message: type[Message]) -> Schema:
    data = build_file_descriptor_set(message).SerializeToString(deterministic=True)
    return Schema(data=data, encoding="protobuf", id=0, name=message.DESCRIPTOR.full_name)
