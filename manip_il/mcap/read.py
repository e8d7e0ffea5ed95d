"""Read the messages of one MCAP file, topic by topic: stamps, rows of values, pictures."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Message, Schema
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data.pictures import decode_picture
from manip_il.errors import ManipError, nearest
from manip_il.mcap.mapping import TEXT, Mapping, Source
from manip_il.mcap.path import values_at

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
Rows = list[list[Any]]
Stored = tuple[Schema | None, Channel, Message]

_LARGEST_RECORD = 1024**3  # [bytes]
_ENCODINGS = {"rgb8": slice(None), "bgr8": slice(None, None, -1)}  # of raw pictures -> their channels as R, G, B


def read_topics(path: Path, mapping: Mapping) -> tuple[Counter[str], dict[str, I64], dict[str, Rows]]:
    """Read all but the pictures, which are left to `read_pictures`.

    Returns how many messages every topic of the file has, the wanted topics' stamps, (N,) [ns], and the rows of every
    column of numbers or text, N of as many values. Raises `ManipError` naming file and topic if there are no messages,
    they cannot be decoded, lack a field, or their stamps do not ascend.
    """
    counts: Counter[str] = Counter()
    rows: dict[str, Rows] = {key: [] for key in mapping.sources}
    stamps: dict[str, list[int]] = {source.topic: [] for source in mapping.sources.values()}
    wanted: dict[str, list[tuple[str, Source]]] = {topic: [] for topic in stamps}
    for key, source in mapping.sources.items():
        wanted[source.topic] += [] if source.is_camera else [(key, source)]
    factory = DecoderFactory()
    for stored in _stored(path):
        topic, stamp = stored[1].topic, stored[2].log_time
        counts[topic] += 1
        if topic not in stamps:
            continue
        with _naming(path, topic, stamp):
            if stamps[topic] and stamp <= stamps[topic][-1]:
                raise ManipError(f"the message before it is stamped {stamps[topic][-1]} ns; expected ascending times")
            stamps[topic].append(stamp)
            content = _content(factory, *stored) if wanted[topic] else None
            for key, source in wanted[topic]:
                rows[key].append(_row(key, source, content, len(rows[key][0]) if rows[key] else None))
    for topic, times in stamps.items():
        if not times:
            known = ", ".join(sorted(counts)) or "none"
            raise ManipError(f"{path} has no messages of {topic}{nearest(topic, counts)}; its topics: {known}")
    return counts, {topic: np.array(times, np.int64) for topic, times in stamps.items()}, rows


def read_pictures(path: Path, topic: str, numbers: I64) -> Iterator[U8]:
    """Yield pictures of a topic, (height, width, 3). numbers: of its messages, (T,), never descending.

    Raises `ManipError` naming file, topic and stamp for a message that holds no picture.
    """
    messages = enumerate(stored for stored in _stored(path) if stored[1].topic == topic)
    factory, at, picture = DecoderFactory(), -1, np.empty((0, 0, 3), np.uint8)
    for number in numbers.tolist():
        while at < number:
            at, stored = next(messages)
            if at == number:
                with _naming(path, topic, stored[2].log_time):
                    picture = _picture(stored[0], _content(factory, *stored))
        yield picture


def _stored(path: Path) -> Iterator[Stored]:
    """Yield every message as stored; the checksums of chunks and data are compared."""
    try:
        with open(checks.open_regular(path), "rb") as stream:
            reader = NonSeekingReader(stream, validate_crcs=True, record_size_limit=_LARGEST_RECORD)
            yield from reader.iter_messages(log_time_order=False)
    except MemoryError:
        raise
    except Exception as error:  # a damaged file can make a parser raise anything
        why = str(error) or type(error).__name__
        raise ManipError(f"cannot read {path}: {why}; expected a complete MCAP file") from error


def _content(factory: DecoderFactory, schema: Schema | None, channel: Channel, message: Message) -> Any:
    """Return a message's protobuf message, or the content of its JSON."""
    if channel.message_encoding == "json":
        return json.loads(message.data)
    if decoder := factory.decoder_for(channel.message_encoding, schema):
        return decoder(message.data)
    encoding = channel.message_encoding
    raise ManipError(f"messages encoded as {encoding!r}; expected protobuf (with its schema) or json; convert the file")


@contextmanager
def _naming(path: Path, topic: str, stamp: int) -> Generator[None]:
    """Make a `ManipError` that names a message of whatever goes wrong with it: parsers have errors of their own."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        raise ManipError(f"{path}, topic {topic} at {stamp} ns: {str(error) or type(error).__name__}") from error


def _row(key: str, source: Source, content: Any, width: int | None) -> list[Any]:
    """Return a message's values. width: of the rows before."""
    row = [value for path in source.paths for value in values_at(path, content)]
    if (width := source.width or width) not in (None, len(row)):
        raise ManipError(f"{len(row)} values; {key} has {width}")
    for value in row:
        if not isinstance(value, str if source.dtype == TEXT else int | float):
            raise ManipError(f"{key} holds {checks.shorten(value)}; expected {source.dtype}")
    return row


def _picture(schema: Schema | None, message: Any) -> U8:
    """Return the picture (height, width, 3) in a message. Raises `ManipError` or `ValueError` for one of no kind."""
    name = schema.name if schema else "no schema"
    if name == "foxglove.CompressedImage":
        return decode_picture(message.data)
    if name != "foxglove.RawImage":
        raise ManipError(f"a message of {name}; pictures are read from foxglove.RawImage and foxglove.CompressedImage")
    if message.encoding not in _ENCODINGS:
        raise ManipError(f"its pictures are encoded as {message.encoding!r}; expected {' or '.join(_ENCODINGS)}")
    height, width, step = message.height, message.width, message.step or message.width * 3
    if step < width * 3 or len(message.data) != height * step:
        raise ManipError(f"a picture of {height} x {width} with {len(message.data)} bytes, {step} a row")
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)
    return np.ascontiguousarray(rows[:, : width * 3].reshape(height, width, 3)[:, :, _ENCODINGS[message.encoding]])
