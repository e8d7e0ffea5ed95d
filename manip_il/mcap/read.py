"""Read the messages of one MCAP file, topic by topic: stamps, rows of values, pictures."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message as Proto
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data.mcap_records import MIB, Budget, read_messages
from manip_il.data.pictures import open_picture
from manip_il.errors import ManipError, nearest
from manip_il.mcap.mapping import Values

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

LARGEST_FILE = 2048 * MIB  # messages and pictures, unpacked [bytes]
_LARGEST_RATIO = 1000  # times the file's size, where that is more: a dark JPEG reaches 200
LARGEST_NUMBERS = 8 * MIB  # a message of JSON, or of protobuf that is no picture [bytes]
LARGEST_DECODED = 512 * MIB  # all of those that are decoded [bytes]
LARGEST_ROWS = 256 * MIB  # the values that are kept until the file is read to its end, as Python has them [bytes]
_ROW_BYTES = 100  # of an empty row

_RAW, _COMPRESSED = "foxglove.RawImage", "foxglove.CompressedImage"
_PICTURES: dict[str, Any] = {_RAW: RawImage, _COMPRESSED: CompressedImage}
_ENCODINGS = {"rgb8": slice(None), "bgr8": slice(None, None, -1)}  # of raw pictures -> their channels as R, G, B
_COLOURS = ("RGB", "L", "P", "1")  # PIL's modes that RGB holds without loss


class Reading(NamedTuple):
    """One message, decoded."""

    topic: str
    schema: str
    stamp: int  # log time [ns]
    content: Any  # protobuf message, or the content of JSON


@dataclass
class Topics:
    """Content of a file's wanted topics. counts: messages of every topic in the file."""

    path: Path
    counts: Counter[str] = field(default_factory=Counter)
    stamps: dict[str, I64] = field(default_factory=dict)  # topic -> (N,) [ns]
    rows: dict[str, list[list[Any]]] = field(default_factory=dict)  # column -> N rows of values


def read_topics(path: Path, topics: Iterable[str], values: dict[str, Values]) -> Topics:
    """Read the topics' stamps and the columns' rows; pictures are left to `read_pictures`.

    Raises `ManipError` naming file and topic where there are no messages, they cannot be decoded, lack a field, or
    their stamps do not ascend.
    """
    found = Topics(path, rows={key: [] for key in values})
    stamps: dict[str, list[int]] = {topic: [] for topic in topics}
    decoded, kept = {source.topic for source in values.values()}, 0
    for reading in _read(path, stamps, found.counts, decoded):
        mine = stamps[reading.topic]
        if mine and reading.stamp <= mine[-1]:
            raise ManipError(
                f"{path}, topic {reading.topic}: message {len(mine)} is stamped {reading.stamp} ns, the one before it "
                f"{mine[-1]} ns; expected ascending log times"
            )
        mine.append(reading.stamp)
        for key, source in values.items():
            if source.topic == reading.topic:
                row = _row(path, key, source, reading)
                kept += _ROW_BYTES + sum(map(sys.getsizeof, row))
                if kept > LARGEST_ROWS:
                    limit = LARGEST_ROWS // MIB
                    raise ManipError(f"{path}: its values take more than {limit} MiB; split it into episodes")
                found.rows[key].append(row)
    for topic, mine in stamps.items():
        if not mine:
            hint = nearest(topic, found.counts)
            known = ", ".join(sorted(found.counts)) or "none"
            raise ManipError(f"{path} has no messages of {topic}{hint}; its topics: {known}")
        found.stamps[topic] = np.array(mine, np.int64)
    return found


def read_pictures(path: Path, topic: str, numbers: I64) -> Iterator[U8]:
    """Yield pictures of a topic, (height, width, 3). numbers: of its messages, (T,), never descending.

    Raises `ManipError` naming file, topic and stamp for a message that holds no picture.
    """
    budget = Budget(path.stat().st_size, LARGEST_FILE, _LARGEST_RATIO)
    readings = enumerate(_read(path, [topic], Counter(), [topic]))
    at, picture = -1, np.empty((0, 0, 3), np.uint8)
    for number in numbers.tolist():
        while at < number:
            at, reading = next(readings)
            if at == number:
                try:
                    picture = _decode_message(reading)
                    budget.take(picture.nbytes)
                except (ManipError, ValueError) as error:
                    raise ManipError(f"{path}, topic {topic} at {reading.stamp} ns: {error}") from error
        yield picture


def decode_picture(data: bytes) -> U8:
    """Decode a PNG or JPEG to RGB (height, width, 3). Raises `ManipError` for anything else."""
    try:
        with open_picture(data) as picture:
            if picture.mode not in _COLOURS:
                raise ManipError(f"a picture of mode {picture.mode}; expected 8-bit colours without transparency")
            return np.asarray(picture.convert("RGB"))
    except (OSError, ValueError, SyntaxError) as error:
        raise ManipError(f"a picture that cannot be decoded: {error}") from error


def _row(path: Path, key: str, source: Values, reading: Reading) -> list[Any]:
    try:
        row = [value for one in source.field for value in one.values(reading.content)]
        if any(isinstance(value, dict | list | Proto) for value in row):
            raise ManipError("a value that has fields or elements of its own; choose one by .name, [0] or [:]")
        if source.width not in (None, len(row)):
            raise ManipError(f"{len(row)} values, {key} has {source.width}")
        return row
    except ManipError as error:
        raise ManipError(f"{path}, topic {source.topic} at {reading.stamp} ns: {error}") from error


def _read(path: Path, topics: Iterable[str], counts: Counter[str], decoded: Collection[str]) -> Iterator[Reading]:
    """Yield the topics' messages as stored, with their content for `decoded` ones; count those of every topic."""
    wanted, numbers = set(topics), Budget(0, LARGEST_DECODED, 0)
    decoders: dict[int, Callable[[bytes], Any]] = {}
    factory = DecoderFactory()
    try:
        with open(checks.open_regular(path), "rb") as stream:
            budget = Budget(path.stat().st_size, LARGEST_FILE, _LARGEST_RATIO)
            for schema, channel, message in read_messages(stream, budget):
                counts[channel.topic] += 1
                if channel.topic not in wanted:
                    continue
                content, name = None, schema.name if schema else ""
                if channel.topic in decoded:
                    place = f"{path}, topic {channel.topic} at {message.log_time} ns"
                    if name not in _PICTURES:
                        _check_size(place, len(message.data), numbers)
                    if channel.id not in decoders:
                        decoders[channel.id] = _decoder(path, factory, schema, channel)
                    content = _decode(place, decoders[channel.id], channel, message.data)
                yield Reading(channel.topic, name, message.log_time, content)
    except ManipError:
        raise
    except Exception as error:  # a damaged file can make a parser raise anything
        why = str(error) or type(error).__name__
        raise ManipError(f"cannot read {path}: {why}; expected a complete MCAP file") from error


def _check_size(place: str, size: int, numbers: Budget) -> None:
    """Refuse what would take many times its size once it is decoded: a list of empty lists takes twenty times."""
    if size > LARGEST_NUMBERS:
        raise ManipError(f"{place}: a message of {size:,} bytes; expected at most {LARGEST_NUMBERS:,}")
    numbers.take(size)


def _decoder(path: Path, factory: DecoderFactory, schema: Schema | None, channel: Channel) -> Callable[[bytes], Any]:
    """Return the decoder of a channel's messages. Pictures are decoded by our schemas, not by the file's."""
    encoding = channel.message_encoding
    if encoding == "json":
        return json.loads
    if schema and encoding == schema.encoding == "protobuf" and schema.name in _PICTURES:
        return _PICTURES[schema.name].FromString
    if decoder := factory.decoder_for(encoding, schema):
        return decoder
    raise ManipError(
        f"{path}, topic {channel.topic}: its messages are encoded as {encoding!r}; expected protobuf "
        "(with its schema) or json; convert the file first"
    )


def _decode(place: str, decoder: Callable[[bytes], Any], channel: Channel, data: bytes) -> Any:
    try:
        return decoder(data)
    except Exception as error:  # protobuf and JSON have errors of their own
        raise ManipError(f"{place}: a message that is not {channel.message_encoding}: {error}") from error


def _decode_message(reading: Reading) -> U8:
    """Return the picture (height, width, 3) in a message. Raises `ManipError` for one that holds none."""
    schema, message = reading.schema, reading.content
    if schema not in _PICTURES or not hasattr(message, "DESCRIPTOR"):  # which JSON lacks
        raise ManipError(
            f"a message of {schema or 'no schema'}; pictures are read from foxglove.RawImage and "
            "foxglove.CompressedImage in protobuf"
        )
    return decode_picture(message.data) if schema == _COMPRESSED else _decode_raw(message)


def _decode_raw(message: Any) -> U8:
    if message.encoding not in _ENCODINGS:
        raise ManipError(f"its pictures are encoded as {message.encoding!r}; expected {' or '.join(_ENCODINGS)}")
    height, width, step = message.height, message.width, message.step or message.width * 3
    if step < width * 3 or len(message.data) != height * step:
        raise ManipError(f"a picture of {height} x {width} with {len(message.data)} bytes, {step} a row")
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)
    return np.ascontiguousarray(rows[:, : width * 3].reshape(height, width, 3)[:, :, _ENCODINGS[message.encoding]])
