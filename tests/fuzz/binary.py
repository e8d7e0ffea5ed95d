"""Mutations of MCAP, parquet, safetensors and npy files by their structure."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from .trees import LENGTHS, damaged, mutate_json, mutate_tree


def mutate_safetensors(rng: Random, data: bytes) -> bytes:
    """Weights whose header says something else, mostly with the header's true length."""
    size = struct.unpack("<Q", data[:8])[0]
    choice = rng.random()
    if choice < 0.3:
        return damaged(rng, data[: 8 + size]) + data[8 + size :]
    header = mutate_json(rng, data[8 : 8 + size])
    if choice < 0.9:
        header += b" " * (-len(header) % 8)
        return struct.pack("<Q", len(header)) + header + data[8 + size :]
    return struct.pack("<Q", rng.choice(LENGTHS)) + header + data[8 + size :]


def mutate_npy(rng: Random, data: bytes) -> bytes:
    """An array whose header lies, or another array."""
    choice = rng.randrange(5)
    if choice == 0 or len(data) < 10:
        return damaged(rng, data)
    if choice == 1:
        stream = io.BytesIO()
        try:
            with np.errstate(all="ignore"):
                np.save(stream, _other_array(rng, np.load(io.BytesIO(data))))
        except Exception:  # it was mutated before, so that reading it may fail in any way
            return damaged(rng, data)
        return stream.getvalue()
    size = struct.unpack("<H", data[8:10])[0]
    shape = rng.choice(("()", "(0,)", "(-1,)", "(2**40,)", "(1099511627776,)", "(9, 9, 9)", "(1,) * 99", "None"))
    descr = rng.choice(
        ("'<f8'", "'|O'", "'<U9999999'", "[('a', '<f8')]", "'<M8[ns]'", "'|V0'", "{}", "'<c16'", "'>f4'")
    )
    header = f"{{'descr': {descr}, 'fortran_order': {rng.choice(('False', 'True', '3'))}, 'shape': {shape}, }}".encode()
    header = rng.choice((header, b"(" * 5_000, header + b" " * 20_000))
    return data[:8] + struct.pack("<H", min(len(header), 65_535)) + header[:65_535] + data[10 + size :]


def _other_array(rng: Random, array: np.ndarray) -> np.ndarray:
    """Another length, shape, dtype, or values that nobody expects."""
    choice = rng.randrange(6)
    if choice == 0:
        return array[: rng.randrange(len(array) + 1)] if array.ndim else array
    if choice == 1:
        return array.reshape(-1)
    if choice == 2:
        return array.astype(rng.choice(("<f8", "<f4", "<i8", "?", "<U8", "<c16", "u1")))
    if choice == 3:
        return np.repeat(array[None], 3, axis=0)
    values = array.astype(np.float64) if choice == 4 else array.copy()
    if values.size:
        odd = (np.nan, np.inf, -1, 2**62, 1e300) if values.dtype.kind == "f" else (0, 1, 100)
        values.reshape(-1)[rng.randrange(values.size)] = rng.choice(odd)
    return values


def mutate_mcap(rng: Random, data: bytes) -> bytes:
    """An MCAP file with true checksums, in which a record says something else; at times a damaged one."""
    if rng.random() < 0.2:
        return damaged(rng, data)
    records = list(StreamReader(io.BytesIO(data)).records)
    kind = rng.choice((Metadata, Metadata, Metadata, Attachment, Attachment, Message, Message, Schema, Channel))
    places = [number for number, record in enumerate(records) if isinstance(record, kind)]
    for _ in range(rng.choice((1, 1, 3))):
        if places:
            place = rng.choice(places)
            records[place] = _CHANGED[kind](rng, records[place])
    if rng.random() < 0.1 and places:
        del records[rng.choice(places)]
    if rng.random() < 0.1 and places:
        records.insert(rng.choice(places), records[rng.choice(places)])
    return _packed(rng, records)


def change_metadata(rng: Random, record: Metadata) -> Metadata:
    """Another name, or texts that say something else."""
    values: dict[str, Any] = dict(record.metadata)
    key = rng.choice(list(values) or [""])
    try:
        json.loads(values[key])
        values[key] = mutate_json(rng, values[key].encode()).decode(errors="replace")
    except (ValueError, KeyError, RecursionError):  # no JSON, or none any more
        values = mutate_tree(rng, values)
    flat = values if isinstance(values, dict) else {"x": str(values)[:1_000]}
    name = record.name if rng.random() < 0.95 else rng.choice(("", "x", record.name * 2))
    return Metadata(name=name, metadata={_text(one): _text(value) for one, value in flat.items()})


def _text(value: Any) -> str:
    text = value if isinstance(value, str) else str(value)
    return text.encode(errors="replace").decode()


def _attachment(rng: Random, record: Attachment) -> Attachment:
    name = (
        record.name if rng.random() < 0.7 else rng.choice(("", "../x.npy", "x.npy", "seed.npy", "é\n.npy", "a" * 9_999))
    )
    is_array = record.data[:6] == b"\x93NUMPY"
    return replace(record, name=_text(name), data=(mutate_npy if is_array else damaged)(rng, record.data))


def _message(rng: Random, record: Message) -> Message:
    is_json = record.data[:1] == b"{"
    time = record.log_time if rng.random() < 0.7 else rng.choice((0, 1, 2**63, 2**64 - 1))
    try:
        content = mutate_json(rng, record.data) if is_json else damaged(rng, record.data)
    except (ValueError, RecursionError):  # it is no JSON any more
        content = damaged(rng, record.data)
    return replace(record, log_time=time, data=content, publish_time=time)


def _schema(rng: Random, record: Schema) -> Schema:
    encoding = rng.choice((record.encoding, "", "jsonschema", "ros2msg", "protobuf"))
    name = rng.choice((record.name, "", "x", "foxglove.RawImage", "foxglove.CompressedImage", "a\nb"))
    return replace(record, data=damaged(rng, record.data), encoding=encoding, name=name)


def _channel(rng: Random, record: Channel) -> Channel:
    return replace(
        record,
        topic=rng.choice((record.topic, "", "/x", "/" + "a" * 9_999, "/a\nb", "../x")),
        message_encoding=rng.choice((record.message_encoding, "", "json", "protobuf", "cdr")),
        metadata=rng.choice((record.metadata, {}, {"x": "y" * 9_999})),
        schema_id=rng.choice((record.schema_id, 0, 1)),
    )


_CHANGED: dict[type, Callable[[Random, Any], Any]] = {
    Metadata: change_metadata,
    Attachment: _attachment,
    Message: _message,
    Schema: _schema,
    Channel: _channel,
}


def _packed(rng: Random, records: list[Any]) -> bytes:
    """The records as a file; what names a channel or schema that is gone is left out."""
    stream = io.BytesIO()
    compression = rng.choice((CompressionType.ZSTD, CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE))
    writer = Writer(stream, compression=compression, enable_data_crcs=True)
    writer.start()
    schemas, channels = {0: 0}, dict[int, int]()
    for record in records:
        if isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels:
            schema = schemas.get(record.schema_id, 0)
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schema, record.metadata
            )
        elif isinstance(record, Message) and record.channel_id in channels:
            channel = channels[record.channel_id]
            writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            create, log = record.create_time, record.log_time
            writer.add_attachment(create, log, record.name, record.media_type, record.data)
    writer.finish()
    return stream.getvalue()


def mutate_parquet(rng: Random, data: bytes) -> bytes:
    """A table that is written anew with another column, type, value or footer; at times a damaged file."""
    if rng.random() < 0.3:
        return damaged(rng, data)
    table = pq.read_table(io.BytesIO(data))
    for _ in range(rng.choice((1, 1, 2))):
        if table.num_columns:
            table = rng.choice(_TABLES)(rng, table)
    stream = io.BytesIO()
    try:
        pq.write_table(table, stream, compression=rng.choice(("snappy", "zstd", "none")))
    except (pa.ArrowException, OverflowError):  # a type that parquet has not
        return damaged(rng, data)
    return stream.getvalue()


def _column(rng: Random, table: pa.Table) -> int:
    return rng.randrange(table.num_columns)


def _without(rng: Random, table: pa.Table) -> pa.Table:
    return table.remove_column(_column(rng, table))


def _renamed(rng: Random, table: pa.Table) -> pa.Table:
    names = list(table.column_names)
    names[_column(rng, table)] = rng.choice(("", "x", "../x", names[0], "a\nb", "é" * 500))
    return table.rename_columns(names)


def _rows(rng: Random, table: pa.Table) -> pa.Table:
    choice = rng.randrange(4)
    if choice == 0:
        return table.slice(0, 0)
    if choice == 1:
        return table.slice(rng.randrange(max(len(table), 1)))
    return pa.concat_tables([table] * rng.choice((2, 50))) if choice == 2 else table.take(list(range(len(table)))[::-1])


def _retyped(rng: Random, table: pa.Table) -> pa.Table:
    place, rows = _column(rng, table), len(table)
    column = rng.choice(
        (
            pa.nulls(rows, pa.float32()),
            pa.nulls(rows),
            pa.array([[1.0] * (number % 3) for number in range(rows)]),
            pa.array([None if number % 2 else [0.5] for number in range(rows)]),
            pa.array([[[1]]] * rows),
            pa.array(["é" * 10] * rows),
            pa.array([b"\xff"] * rows),
            pa.array([{"a": 1}] * rows),
            pa.array([True] * rows),
            pa.array([2**63 - 1] * rows),
            pa.array([-1] * rows),
            pa.array([float("nan")] * rows),
            pa.array([rng.choice((0, 1, 10**6)) for _ in range(rows)]),
            pa.array(range(rows), pa.timestamp("us")),
            pa.array(range(rows), pa.uint64()),
            pa.array(["a"] * rows).dictionary_encode(),
            pa.array(["x" * 1_000_000] * min(rows, 3) + [""] * max(rows - 3, 0)),
        )
    )
    return table.set_column(place, table.column_names[place], column)


def _with_null(rng: Random, table: pa.Table) -> pa.Table:
    place = _column(rng, table)
    values = table.column(place).to_pylist()
    if values:
        values[rng.randrange(len(values))] = None
    return table.set_column(place, table.column_names[place], pa.array(values, table.column(place).type))


def _footer(rng: Random, table: pa.Table) -> pa.Table:
    metadata = dict(table.schema.metadata or {b"huggingface": b'{"info": {"features": {}}}'})
    key = rng.choice(list(metadata))
    try:
        metadata[key] = mutate_json(rng, metadata[key])
    except (ValueError, RecursionError):
        metadata[key] = damaged(rng, metadata[key])
    return table.replace_schema_metadata(metadata)


_TABLES: tuple[Callable[[Random, pa.Table], pa.Table], ...] = (
    *(_without, _renamed, _rows, _retyped, _retyped, _retyped, _with_null, _footer),
)
