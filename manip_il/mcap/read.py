"""The messages of one MCAP file, topic by topic, as stamps and rows of values."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message as Proto
from mcap.records import Channel, Message, Schema
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from manip_il.errors import ManipError, nearest
from manip_il.mcap.frames import decode_message
from manip_il.mcap.mapping import Values
from manip_il.mcap.records import MIB, Budget, read_messages

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

LARGEST_FILE = 2048 * MIB  # messages and pictures, unpacked [bytes]
_LARGEST_RATIO = 1000  # or so many times the file's size, where that is more: a dark JPEG reaches 200
LARGEST_NUMBERS = 8 * MIB  # a message of JSON, or of protobuf that is no picture [bytes]
LARGEST_DECODED = 512 * MIB  # all of those that are decoded [bytes]
LARGEST_ROWS = 256 * MIB  # the values that are kept until the file is read to its end, as Python has them [bytes]
_ROW_BYTES = 100  # of an empty row


_PICTURES: dict[str, Any] = {"foxglove.RawImage": RawImage, "foxglove.CompressedImage": CompressedImage}


class Reading(NamedTuple):
    """One message, decoded."""

    topic: str
    schema: str
    stamp: int  # log time [ns]
    content: Any  # protobuf message, or what JSON holds


@dataclass
class Topics:
    """What a file holds of the wanted topics. counts: messages of every topic in the file."""

    path: Path
    counts: Counter[str] = field(default_factory=Counter)
    stamps: dict[str, I64] = field(default_factory=dict)  # topic -> (N,)
    rows: dict[str, list[list[Any]]] = field(default_factory=dict)  # column -> N rows of values


def read_topics(path: Path, topics: Iterable[str], values: dict[str, Values]) -> Topics:
    """Stamps of the topics and rows of the columns; pictures are left to `read_pictures`.

    Raises `ManipError` naming file and topic where there are no messages, they cannot be decoded, lack a field, or
    their stamps do not ascend.
    """
    found = Topics(path, rows={key: [] for key in values})
    stamps: dict[str, list[int]] = {topic: [] for topic in topics}
    decoded, kept = {source.topic for source in values.values()}, 0
    for reading in _readings(path, stamps, found.counts, decoded):
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
                    raise ManipError(
                        f"{path}: its values take more than {LARGEST_ROWS // MIB} MiB; split it into episodes"
                    )
                found.rows[key].append(row)
    for topic, mine in stamps.items():
        if not mine:
            hint = nearest(topic, found.counts)
            known = ", ".join(sorted(found.counts)) or "none"
            raise ManipError(f"{path} has no messages of {topic}{hint}; its topics: {known}")
        found.stamps[topic] = np.array(mine, np.int64)
    return found


def read_pictures(path: Path, topic: str, chosen: I64) -> Iterator[U8]:
    """Yield the chosen pictures of a topic, (height, width, 3); `chosen`: message numbers that never descend.

    Raises `ManipError` naming file, topic and stamp for a message that holds no picture.
    """
    budget = Budget(path.stat().st_size, LARGEST_FILE, _LARGEST_RATIO)
    readings = enumerate(_readings(path, [topic], Counter(), [topic]))
    at, picture = -1, np.empty((0, 0, 3), np.uint8)
    for number in chosen.tolist():
        while at < number:
            at, reading = next(readings)
            if at == number:
                try:
                    picture = decode_message(reading.schema, reading.content)
                    budget.take(picture.nbytes)
                except (ManipError, ValueError) as error:
                    raise ManipError(f"{path}, topic {topic} at {reading.stamp} ns: {error}") from error
        yield picture


def _row(path: Path, key: str, source: Values, reading: Reading) -> list[Any]:
    try:
        row = [value for one in source.field for value in one.values(reading.content)]
        if any(isinstance(value, dict | list | Proto) for value in row):
            raise ManipError("a value that has fields or elements of its own; choose one by .name, [0] or [:]")
        wanted = source.width
        if wanted is not None and len(row) != wanted:
            raise ManipError(f"{len(row)} values, {key} has {wanted}")
        return row
    except ManipError as error:
        raise ManipError(f"{path}, topic {source.topic} at {reading.stamp} ns: {error}") from error


def _readings(path: Path, topics: Iterable[str], counts: Counter[str], decoded: Collection[str]) -> Iterator[Reading]:
    """The topics' messages as stored, of `decoded` ones with their content; `counts` grows by those of every topic."""
    wanted, numbers = set(topics), Budget(0, LARGEST_DECODED, 0)
    decoders: dict[int, Callable[[bytes], Any]] = {}
    factories: list[Any] = [_PictureFactory(), DecoderFactory(), _JsonFactory()]
    with _explain(path), path.open("rb") as stream:
        budget = Budget(path.stat().st_size, LARGEST_FILE, _LARGEST_RATIO)
        for schema, channel, message in read_messages(stream, budget):
            counts[channel.topic] += 1
            if channel.topic not in wanted:
                continue
            content = None
            if channel.topic in decoded:
                if not _is_picture(schema):
                    _check_size(path, channel, message, numbers)
                if channel.id not in decoders:
                    decoders[channel.id] = _decoder(path, factories, schema, channel)
                content = _decoded(path, decoders[channel.id], channel, message)
            yield Reading(channel.topic, schema.name if schema else "", message.log_time, content)


def _is_picture(schema: Schema | None) -> bool:
    return schema is not None and schema.name in _PICTURES


def _check_size(path: Path, channel: Channel, message: Message, numbers: Budget) -> None:
    """Refuse what would take many times its size once it is decoded: a list of empty lists takes twenty times."""
    size = len(message.data)
    if size > LARGEST_NUMBERS:
        where = f"{path}, topic {channel.topic} at {message.log_time} ns"
        raise ManipError(f"{where}: a message of {size:,} bytes; expected at most {LARGEST_NUMBERS:,}")
    numbers.take(size)


class _PictureFactory:
    """Pictures by the schemas that we know, whatever a file says that they are."""

    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Callable[[bytes], Any] | None:
        if message_encoding != "protobuf" or schema is None or schema.encoding != "protobuf":
            return None
        return _PICTURES[schema.name].FromString if schema.name in _PICTURES else None


class _JsonFactory:
    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Callable[[bytes], Any] | None:
        return json.loads if message_encoding == "json" else None


def _decoder(path: Path, factories: list[Any], schema: Schema | None, channel: Channel) -> Callable[[bytes], Any]:
    for factory in factories:
        if decoder := factory.decoder_for(channel.message_encoding, schema):
            return decoder
    raise ManipError(
        f"{path}, topic {channel.topic}: its messages are encoded as {channel.message_encoding!r}; expected protobuf "
        "(with its schema) or json; convert the file first"
    )


def _decoded(path: Path, decoder: Callable[[bytes], Any], channel: Channel, message: Message) -> Any:
    try:
        return decoder(message.data)
    except Exception as error:  # protobuf and JSON have errors of their own
        where, what = f"{path}, topic {channel.topic} at {message.log_time} ns", channel.message_encoding
        raise ManipError(f"{where}: a message that is not {what}: {error}") from error


@contextmanager
def _explain(path: Path) -> Generator[None]:
    try:
        yield
    except ManipError:
        raise
    except Exception as error:  # a damaged file can make a parser raise anything
        why = str(error) or type(error).__name__
        raise ManipError(f"cannot read {path}: {why}; expected a complete MCAP file") from error
