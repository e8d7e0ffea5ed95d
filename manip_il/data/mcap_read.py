"""The messages of one MCAP file, topic by topic, as stamps and rows of values."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Message, Schema
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from manip_il.data.mcap_frames import decode_message
from manip_il.data.mcap_mapping import Values
from manip_il.errors import ManipError, nearest

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


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
    for reading in _readings(path, stamps, found.counts):
        mine = stamps[reading.topic]
        if mine and reading.stamp <= mine[-1]:
            raise ManipError(
                f"{path}, topic {reading.topic}: message {len(mine)} is stamped {reading.stamp} ns, the one before it "
                f"{mine[-1]} ns; expected ascending log times"
            )
        mine.append(reading.stamp)
        for key, source in values.items():
            if source.topic == reading.topic:
                found.rows[key].append(_row(path, key, source, reading))
    for topic, mine in stamps.items():
        if not mine:
            hint = nearest(topic, found.counts)
            known = ", ".join(sorted(found.counts)) or "none"
            raise ManipError(f"{path} has no messages of {topic}{hint}; its topics: {known}")
        found.stamps[topic] = np.array(mine, np.int64)
    return found


def read_pictures(path: Path, topic: str, chosen: I64) -> Iterator[U8]:
    """The chosen pictures of a topic, (height, width, 3); `chosen`: message numbers that never descend.

    Raises `ManipError` naming file, topic and stamp for a message that holds no picture.
    """
    readings = enumerate(_readings(path, [topic], Counter()))
    at, picture = -1, np.empty((0, 0, 3), np.uint8)
    for number in chosen.tolist():
        while at < number:
            at, reading = next(readings)
            if at == number:
                try:
                    picture = decode_message(reading.schema, reading.content)
                except ManipError as error:
                    raise ManipError(f"{path}, topic {topic} at {reading.stamp} ns: {error}") from error
        yield picture


def _row(path: Path, key: str, source: Values, reading: Reading) -> list[Any]:
    try:
        row = [value for one in source.field for value in one.values(reading.content)]
        wanted = source.width
        if wanted is not None and len(row) != wanted:
            raise ManipError(f"{len(row)} values, {key} has {wanted}")
        return row
    except ManipError as error:
        raise ManipError(f"{path}, topic {source.topic} at {reading.stamp} ns: {error}") from error


def _readings(path: Path, topics: Iterable[str], counts: Counter[str]) -> Iterator[Reading]:
    """The topics' messages as stored; `counts` grows by those of every topic."""
    wanted = set(topics)
    decoders: dict[int, Callable[[bytes], Any]] = {}
    factories: list[Any] = [DecoderFactory(), _JsonFactory()]
    with _explain(path), path.open("rb") as stream:
        reader = NonSeekingReader(stream, validate_crcs=True)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            counts[channel.topic] += 1
            if channel.topic not in wanted:
                continue
            if channel.id not in decoders:
                decoders[channel.id] = _decoder(path, factories, schema, channel)
            yield Reading(
                channel.topic,
                schema.name if schema else "",
                message.log_time,
                _decoded(path, decoders[channel.id], channel, message),
            )


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
        raise ManipError(f"cannot read {path}: {why}; expected a whole MCAP file") from error
