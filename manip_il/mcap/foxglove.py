"""Channels that Foxglove shows as they stand, one message a frame, and pictures read back from them.

Schemas: Foxglove's own in protobuf (`JointStates`, `FrameTransforms`, `RawImage`, `Log`), LeRobot's scalars in JSON.
Numbers and pictures keep every bit. Pictures stay raw, as the file's zstd finds what successive frames share: on
rendered frames of 128 x 128 that took a third of a PNG's bytes and a fifth of its time.
"""

from __future__ import annotations

import functools
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.opcode import Opcode
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set
from numpy.typing import NDArray

from manip_il.checks import shorten
from manip_il.mcap.records import Record, to_channel, to_message

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Times = Sequence[int]  # nanoseconds, one a frame

NANOSECONDS = 1_000_000_000
WORLD = "world"
IMAGE_TOPICS = "/observation/images/"  # before a camera's name, as LeRobot has it
RGB = "rgb8"  # bytes R, G, B

# LeRobot's own, word for word (`lerobot.utils.foxglove_visualization`)
_NAMED_NUMBER = {"type": "object", "properties": {"label": {"type": "string"}, "value": {"type": "number"}}}
SCALARS: dict[str, Any] = {
    "type": "object",
    "title": "lerobot.Scalars",
    "properties": {"scalars": {"type": "array", "items": _NAMED_NUMBER}},
}


@dataclass(frozen=True)
class Schema:
    """A message schema as MCAP registers it. encoding: `protobuf`, or `jsonschema` for JSON messages."""

    name: str
    encoding: str
    data: bytes

    @property
    def message_encoding(self) -> str:
        """What the messages themselves are."""
        return "json" if self.encoding == "jsonschema" else self.encoding


@dataclass(frozen=True)
class Channel:
    """One topic. messages: encoded, one a frame; they can be taken once."""

    topic: str
    schema: Schema
    messages: Iterator[bytes]


def log_time(frame: int, fps: int) -> int:
    """Return nanoseconds since the episode's start."""
    return frame * NANOSECONDS // fps


def joint_states(topic: str, names: Sequence[str], values: NDArray[Any], times: Times) -> Channel:
    """Return positions (T, n) of named joints."""

    def messages() -> Iterator[bytes]:
        message = JointStates()
        joints = [message.joints.add(name=name) for name in names]
        for time, row in zip(times, values.tolist(), strict=True):
            _stamp(message.timestamp, time)
            for joint, value in zip(joints, row, strict=True):
                joint.position = value
            yield message.SerializeToString(deterministic=True)

    return Channel(topic, _protobuf_schema(JointStates), messages())


def frame_transforms(topic: str, places: Mapping[str, tuple[F64, F64]], times: Times) -> Channel:
    """Return where frames are in the world. places: frame -> positions (T, 3) [m], quaternions wxyz (T, 4)."""

    def messages() -> Iterator[bytes]:
        message = FrameTransforms()
        transforms = [message.transforms.add(parent_frame_id=WORLD, child_frame_id=frame) for frame in places]
        rows = np.concatenate([np.concatenate(place, axis=1) for place in places.values()], axis=1)
        for time, row in zip(times, rows.tolist(), strict=True):
            for start, transform in enumerate(transforms):
                _stamp(transform.timestamp, time)
                position, rotation = transform.translation, transform.rotation
                position.x, position.y, position.z, rotation.w, rotation.x, rotation.y, rotation.z = row[
                    7 * start : 7 * start + 7
                ]
            yield message.SerializeToString(deterministic=True)

    return Channel(topic, _protobuf_schema(FrameTransforms), messages())


def scalars(topic: str, labels: Sequence[str], rows: Iterable[Sequence[float]]) -> Channel:
    """Labelled numbers; rows: T of Python's numbers, which must be finite, as JSON has no others."""
    # filling a template is five times as fast as encoding a dict
    slots = (f'{{"label":{json.dumps(label).replace("%", "%%")},"value":%r}}' for label in labels)
    template = f'{{"scalars":[{",".join(slots)}]}}'
    schema = Schema(SCALARS["title"], "jsonschema", json.dumps(SCALARS).encode())
    return Channel(topic, schema, ((template % tuple(row)).encode() for row in rows))


def images(topic: str, frame_id: str, pictures: Iterable[U8], times: Times) -> Channel:
    """Return RGB pictures (height, width, 3), without loss."""

    def messages() -> Iterator[bytes]:
        message = RawImage(frame_id=frame_id, encoding=RGB)
        for time, picture in zip(times, pictures, strict=True):
            _stamp(message.timestamp, time)
            message.height, message.width, depth = picture.shape
            message.step = message.width * depth
            message.data = picture.tobytes()
            yield message.SerializeToString(deterministic=True)

    return Channel(topic, _protobuf_schema(RawImage), messages())


def texts(topic: str, name: str, lines: Iterable[str], times: Times) -> Channel:
    """Text, as log messages from `name`."""

    def messages() -> Iterator[bytes]:
        message = Log(level=Log.Level.INFO, name=name)
        for time, line in zip(times, lines, strict=True):
            _stamp(message.timestamp, time)
            message.message = line
            yield message.SerializeToString(deterministic=True)

    return Channel(topic, _protobuf_schema(Log), messages())


def add_channels(writer: Writer, channels: Sequence[Channel], times: Times) -> None:
    """Write all messages, frame by frame."""
    schema_ids: dict[str, int] = {}
    channel_ids: list[int] = []
    for channel in channels:
        schema = channel.schema
        if schema.name not in schema_ids:
            schema_ids[schema.name] = writer.register_schema(schema.name, schema.encoding, schema.data)
        channel_ids.append(writer.register_channel(channel.topic, schema.message_encoding, schema_ids[schema.name]))
    frames = zip(*(channel.messages for channel in channels), strict=True)
    for frame, (time, messages) in enumerate(zip(times, frames, strict=bool(channels))):
        for channel_id, message in zip(channel_ids, messages, strict=True):
            writer.add_message(channel_id, time, message, time, frame)


def read_images(records: Iterable[Record], cameras: Sequence[str], shape: tuple[int, ...]) -> dict[str, U8]:
    """Return every camera's pictures as `images` wrote them, from a file's records in stored order.

    shape: of what each camera has, (T, height, width, 3). Raises `ValueError` for another camera, another size, and for
    fewer or more pictures.
    """
    topics: dict[int, str] = {}
    pictures: dict[str, U8] = {}
    counts: Counter[str] = Counter()
    for record in records:
        if record.opcode == Opcode.CHANNEL:
            channel = to_channel(record.body)
            if (camera := channel.topic.removeprefix(IMAGE_TOPICS)) != channel.topic:
                if camera not in cameras:
                    raise ValueError(f"it holds pictures of {shorten(camera)}; its header names {shorten(cameras)}")
                topics[channel.id] = camera
        elif record.opcode == Opcode.MESSAGE and (camera := topics.get(int.from_bytes(record.body[:2], "little"))):
            message = RawImage.FromString(to_message(record.body).data)
            if (message.height, message.width, 3) != shape[1:] or counts[camera] == shape[0]:
                found = f"picture {counts[camera]} of {camera}, {message.height} x {message.width}"
                raise ValueError(f"{found}, is not one of {shape[0]} of {shape[1]} x {shape[2]} pixels")
            if camera not in pictures:
                pictures[camera] = np.empty(shape, np.uint8)
            pictures[camera][counts[camera]] = np.frombuffer(message.data, np.uint8).reshape(shape[1:])
            counts[camera] += 1
    for camera, count in counts.items():
        if count != shape[0]:
            raise ValueError(f"it holds {count} pictures of {camera}; expected {shape[0]}")
    return pictures


def _stamp(timestamp: Timestamp, time: int) -> None:
    timestamp.seconds, timestamp.nanos = divmod(time, NANOSECONDS)


@functools.cache
def _protobuf_schema(message: type[Message]) -> Schema:
    data = build_file_descriptor_set(message).SerializeToString(deterministic=True)
    return Schema(message.DESCRIPTOR.full_name, "protobuf", data)
