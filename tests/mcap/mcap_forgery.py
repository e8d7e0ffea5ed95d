"""MCAP files that no writer would write, with checksums that fit."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Header, McapRecord, Message, Metadata, Schema

MAGIC = b"\x89MCAP0\r\n"
MIB = 1024 * 1024


def raw(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def framed(opcode: int, body: bytes, length: int | None = None) -> bytes:
    """A record of any opcode; length: what it says that its body has."""
    return struct.pack("<BQ", opcode, len(body) if length is None else length) + body


def write_mcap(path: Path, *records: McapRecord | bytes, summary: bytes = b"") -> Path:
    """A file of these records in which every checksum fits."""
    head = MAGIC + raw(Header(profile="", library="x"))
    data = head + b"".join(one if isinstance(one, bytes) else raw(one) for one in records)
    data += raw(DataEnd(data_section_crc=zlib.crc32(data)))
    footer = raw(Footer(summary_start=len(data), summary_offset_start=0, summary_crc=0))[:-4]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data + summary + footer + struct.pack("<I", zlib.crc32(summary + footer)) + MAGIC)
    return path


def chunk(compression: str, data: bytes, size: int) -> Chunk:
    return Chunk(compression, data, 0, 0, uncompressed_crc=0, uncompressed_size=size)


def zeros(compression: str, size: int, *, declared: bool = True) -> bytes:
    """So many zeros, compressed piece by piece; declared: the frame says how many they are."""
    pieces = [bytes(min(MIB, size - start)) for start in range(0, size, MIB)]
    if compression == "zstd":
        packer = zstandard.ZstdCompressor().compressobj(size if declared else -1)
        return b"".join([*map(packer.compress, pieces), packer.flush()])
    lz4_packer = lz4.frame.LZ4FrameCompressor()
    begin = lz4_packer.begin(size if declared else 0)
    return b"".join([begin, *map(lz4_packer.compress, pieces), lz4_packer.flush()])


def filler(size: int) -> bytes:
    """The content of a chunk: one record that readers skip."""
    return framed(0x7F, b"", size - 9)


def messages_chunk(messages: Iterable[Message], *before: McapRecord, compression: str = "zstd") -> Chunk:
    data = b"".join(map(raw, [*before, *messages]))
    pack = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}[compression]
    return chunk(compression, pack(data), len(data))


def json_channel(topic: str = "/a", number: int = 1, schema: int = 0) -> Channel:
    return Channel(id=number, topic=topic, message_encoding="json", metadata={}, schema_id=schema)


def message(data: bytes, stamp: int = 0, channel: int = 1) -> Message:
    return Message(channel, stamp, data, stamp, 0)


def schema(name: str, data: bytes, number: int = 1) -> Schema:
    return Schema(data=data, encoding="protobuf", id=number, name=name)


def column(name: str, data: bytes) -> Attachment:
    return Attachment(0, 0, name + ".npy", "", data)


def npy(values: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def npy_header(descr: str, shape: str) -> bytes:
    """The begin of a file of numpy's format, in which the header says anything."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def note(values: dict[str, Any]) -> Metadata:
    return Metadata(name="manip_il", metadata=values)
