"""Read the records of an MCAP file one by one, with limits on their size before and while they are unpacked.

The library's readers unpack a chunk to any size, declared or not, and hold all of its messages at once: 262 kB became
9 GB. Here the declared size is a limit too, and a chunk's messages are cut out one by one.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema

MIB = 1024 * 1024
LARGEST_CHUNK = 128 * MIB  # unpacked [bytes]; writers close a chunk behind the message that takes it over a few MB
LARGEST_MESSAGE = 64 * MIB  # a raw picture of 4096 x 4096 pixels has 48 [bytes]
LARGEST_ATTACHMENT = 128 * MIB  # [bytes]
LARGEST_NOTE = 1 * MIB  # of a schema, a channel or a metadata record [bytes]
MOST_RECORDS = 5_000_000  # in the chunks of a file: an hour of 14 topics at 100 Hz
LARGEST_NOTES = 16 * MIB  # of all schemas and channels of a file [bytes]

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # opcode, size of the body
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_ATTACHMENT_TIMES = 16  # [bytes]
_FOOTER = struct.Struct("<BQQQI")  # opcode, size, where the summary starts, where its offsets start, checksum
_DATA_END = struct.Struct("<BQI")  # opcode, size, checksum
_PIECE = MIB  # read at a time where nothing is kept [bytes]
_PACKED = LARGEST_CHUNK + MIB  # of a packed chunk [bytes]: what cannot be compressed becomes a little longer
_LIMITS = {
    Opcode.CHUNK: _PACKED,
    Opcode.MESSAGE: LARGEST_MESSAGE,
    Opcode.ATTACHMENT: LARGEST_ATTACHMENT,
    Opcode.SCHEMA: LARGEST_NOTE,
    Opcode.CHANNEL: LARGEST_NOTE,
    Opcode.METADATA: LARGEST_NOTE,
}


class Budget:
    """Limit of what a file may unpack to in all [bytes]: `least`, or `ratio` times its size where that is more."""

    def __init__(self, path_size: int, least: int, ratio: int):
        self._limit = self._left = max(least, ratio * path_size)
        self._most = self._records = MOST_RECORDS

    def count(self) -> None:
        """Count a record of a chunk. Raises `ValueError` where they are too many."""
        self._records -= 1
        if self._records < 0:
            raise ValueError(f"it holds more than {self._most:,} messages")

    def take(self, size: int) -> None:
        """Count `size` bytes before they are unpacked. Raises `ValueError` where they are too many."""
        self._left -= size
        if self._left < 0:
            raise ValueError(f"it unpacks to more than {self._limit:,} bytes")


class Record(NamedTuple):
    """One record as stored. opcode: of a wanted kind."""

    opcode: int
    body: bytes


def read_records(stream: BinaryIO, *wanted: Opcode, check: bool = False) -> Iterator[Record]:
    """Yield the wanted records in order, up to the footer.

    check: compare the checksum over the data section, where the file has one. Raises `ValueError` for what is no MCAP
    file, ends too early, does not match its checksum, or holds a wanted record beyond its kind's limit.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    if (magic := stream.read(len(_MAGIC))) != _MAGIC:
        raise ValueError("it is not an MCAP file")
    at, checksum = len(magic), zlib.crc32(magic)
    while True:
        if len(head := stream.read(_HEAD.size)) < _HEAD.size:
            raise ValueError("it ends too early")
        opcode, length = _HEAD.unpack(head)
        at += _HEAD.size + length
        if at > size:
            raise ValueError("it ends too early")
        if opcode == Opcode.FOOTER:
            return
        if opcode == Opcode.DATA_END:
            declared = int.from_bytes(stream.read(length)[:4], "little")
            if check and declared not in (0, checksum):
                raise ValueError("its data does not match its checksum")
            continue
        if opcode in wanted:
            _refuse_large(f"a {Opcode(opcode).name.lower()} record", length, _LIMITS[Opcode(opcode)])
            body = stream.read(length)
            yield Record(opcode, body)
            checksum = zlib.crc32(body, zlib.crc32(head, checksum)) if check else 0
        elif check:
            checksum = _add_sum(stream, length, zlib.crc32(head, checksum))
        else:
            stream.seek(length, os.SEEK_CUR)


def read_messages(stream: BinaryIO, budget: Budget) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """Yield every message as stored, with its channel and schema. All checksums that the file has are compared.

    A writer may repeat a schema or channel; the first of every number counts. Raises `ValueError` for what
    `read_records`, `unpack` or `budget` refuse, and for a schema or channel that is missing.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    size = 0
    for record in read_records(stream, Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, check=True):
        for one in chunk_records(unpack(record, budget), budget) if record.opcode == Opcode.CHUNK else (record,):
            if one.opcode == Opcode.MESSAGE:
                message = to_message(one.body)
                channel = channels.get(message.channel_id)
                if channel is None:
                    raise ValueError(f"a message of channel {message.channel_id}, which it does not define")
                if channel.schema_id and channel.schema_id not in schemas:
                    what = f"channel {channel.topic} has schema {channel.schema_id}"
                    raise ValueError(f"{what}, which it does not define")
                yield schemas.get(channel.schema_id), channel, message
            elif int.from_bytes(one.body[:2], "little") not in (schemas if one.opcode == Opcode.SCHEMA else channels):
                size += len(one.body)
                _refuse_large("its schemas and channels together", size, LARGEST_NOTES)
                if one.opcode == Opcode.SCHEMA:
                    schema = Schema.read(ReadDataStream(BytesIO(one.body)))
                    schemas[schema.id] = schema
                else:
                    channel = to_channel(one.body)
                    channels[channel.id] = channel


def unpack(record: Record, budget: Budget, *, check: bool = True) -> bytes:
    """Return what a chunk holds. check: compare its own checksum, where it has one.

    Raises `ValueError` for one that unpacks to more than `LARGEST_CHUNK`, to another size than it declares, or does not
    fit its checksum.
    """
    chunk: Chunk = Chunk.read(ReadDataStream(BytesIO(record.body)))
    size = chunk.uncompressed_size
    _refuse_large("a chunk, unpacked,", size, LARGEST_CHUNK)
    budget.take(size)
    try:
        data = _decompress(chunk, size)
    except (zstandard.ZstdError, RuntimeError) as error:  # lz4 raises the latter
        raise ValueError(f"a chunk that cannot be unpacked: {error}") from error
    if len(data) != size:
        raise ValueError(f"a chunk unpacks to {len(data):,} bytes or more; it declares {size:,}")
    if check and chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("a chunk does not match its checksum")
    return data


def chunk_records(data: bytes, budget: Budget) -> Iterator[Record]:
    """Yield the schemas, channels and messages of an unpacked chunk, each cut out as it is taken.

    Raises `ValueError` where a record does not fit in the chunk or its kind's limit, and what `budget.count` raises.
    """
    at = 0
    while at < len(data):
        budget.count()
        if at + _HEAD.size > len(data):
            raise ValueError("a chunk ends too early")
        opcode, length = _HEAD.unpack_from(data, at)
        start, at = at + _HEAD.size, at + _HEAD.size + length
        if at > len(data):
            raise ValueError("a chunk ends too early")
        if opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
            _refuse_large(f"a {Opcode(opcode).name.lower()} record", length, _LIMITS[Opcode(opcode)])
            if opcode == Opcode.MESSAGE and length < _MESSAGE.size:
                raise ValueError("a message record ends too early")
            yield Record(opcode, data[start:at])


def to_message(body: bytes) -> Message:
    """Return a message record's content. Raises `ValueError` where it is too short."""
    if len(body) < _MESSAGE.size:
        raise ValueError("a message record ends too early")
    channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(body)
    return Message(channel, log_time, body[_MESSAGE.size :], publish_time, sequence)


def to_channel(body: bytes) -> Channel:
    """Return a channel record's content."""
    return Channel.read(ReadDataStream(BytesIO(body)))


def to_attachment(body: bytes) -> tuple[str, memoryview]:
    """Return an attachment's name and data. Raises `ValueError` where its sizes do not fit the record."""
    view, at = memoryview(body), _ATTACHMENT_TIMES
    texts: list[str] = []
    for _ in ("name", "media type"):
        length = int.from_bytes(view[at : at + 4], "little")
        texts.append(str(view[at + 4 : at + 4 + length], "utf-8"))
        at += 4 + length
    length = int.from_bytes(view[at : at + 8], "little")
    if at + 8 + length + 4 != len(body):  # the data's size before, its checksum behind
        raise ValueError("an attachment whose sizes do not fit its record")
    return texts[0], view[at + 8 : at + 8 + length]


def check_both_sums(stream: BinaryIO) -> None:
    """Compare the checksums over data and summary, as this program's own files have both.

    Raises `ValueError` where one is missing or differs; nothing of the file is kept.
    """
    size = os.fstat(stream.fileno()).st_size
    end = size - len(_MAGIC) - _FOOTER.size
    stream.seek(max(end, 0))
    footer, magic = stream.read(_FOOTER.size), stream.read()
    if end < len(_MAGIC) or magic != _MAGIC:
        raise ValueError("it ends too early")
    opcode, _, summary, _, summary_sum = _FOOTER.unpack(footer)
    data_end = summary - _DATA_END.size
    if opcode != Opcode.FOOTER or not len(_MAGIC) <= data_end < summary <= end:
        raise ValueError("its footer is damaged")
    stream.seek(data_end)
    opcode, _, data_sum = _DATA_END.unpack(stream.read(_DATA_END.size))
    if opcode != Opcode.DATA_END or data_sum == 0:
        raise ValueError("no checksum over its data")
    stream.seek(0)
    if _add_sum(stream, data_end) != data_sum:
        raise ValueError("its data does not match its checksum")
    stream.seek(summary)
    if _add_sum(stream, size - len(_MAGIC) - 4 - summary) != summary_sum:
        raise ValueError("its summary does not match its checksum")


def _decompress(chunk: Chunk, size: int) -> bytes:
    """Return at most one byte more than `size`."""
    if chunk.compression == "zstd":
        declared = zstandard.frame_content_size(chunk.data)  # -1: the frame does not say
        if declared not in (-1, size):
            raise ValueError(f"a chunk declares {size:,} bytes, its zstd frame {declared:,}")
        return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=max(size, 1))
    if chunk.compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    if chunk.compression == "":
        return chunk.data
    raise ValueError(f"a chunk compressed by {chunk.compression[:20]!r}; expected zstd, lz4 or none")


def _add_sum(stream: BinaryIO, length: int, checksum: int = 0) -> int:
    """Return the checksum with the next `length` bytes added, of which little is held at a time."""
    while length > 0:
        piece = stream.read(min(length, _PIECE))
        if not piece:
            raise ValueError("it ends too early")
        length -= len(piece)
        checksum = zlib.crc32(piece, checksum)
    return checksum


def _refuse_large(what: str, size: int, limit: int) -> None:
    if size > limit:
        raise ValueError(f"{what} has {size:,} bytes; expected at most {limit:,}")
