"""Refuse parquet files that would fill the memory, by their page headers, before anything is decoded.

A footer's sizes and counts are only claims, and a run of a billion equal numbers takes eight bytes. The pages' own
headers are what pyarrow allocates and decodes by; they are read first (parquet-format, `PageHeader` in compact Thrift).
So are footers: pyarrow ends the whole process at some damaged ones.
"""

from __future__ import annotations

import mmap
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from manip_il import checks
from manip_il.data.picture_columns import picture_columns

MIB = 1024 * 1024
LARGEST_FOOTER = 32 * MIB  # [bytes]; 10,000 row groups of 20 columns take about 30
LARGEST_PAGE = 64 * MIB  # unpacked [bytes]; writers close a page at one, or behind a batch of long values
_PAGE_RATIO = 4  # or so many times its packed size, where that is more: pictures, packed already
LARGEST_FILE = 128 * MIB  # the values of the columns that are read [bytes]
_FILE_RATIO = 100  # or so many times the files' size, where that is more: real ones reach about 20
MOST_GROUPS = 100_000  # row groups of a file
MOST_COLUMNS = 10_000  # of plain values

_MAGIC = b"PAR1"
_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8}  # of a value [bytes]
_OVERHEAD = 4  # of a value: its levels [bytes]
_TEXT_OVERHEAD = 50  # of a text, as Python has it [bytes]
_CODECS = {1: "snappy", 2: "gzip", 4: "brotli", 6: "zstd", 7: "lz4_raw"}
_ROW_GROUPS, _COLUMNS, _META_DATA = 4, 1, 3  # fields of the footer, a row group, a column
_CHUNK_FIELDS = (4, 5, 7, 9, 11)  # of its meta data: codec, values, packed size, first page of data, of a dictionary
_DATA, _DICTIONARY, _DATA_V2 = 0, 2, 3  # types of pages; 1 is an index
_OWN_HEADER = {_DATA: 5, _DICTIONARY: 7, _DATA_V2: 8}  # the field of a page's header that holds the rest
_BY_DICTIONARY = (2, 8)  # encodings
_DELTA_BYTES = 7  # each text repeats part of the one before, so a page's size does not say how long they are
_ENCODINGS = (0, *_BY_DICTIONARY, 3, 4, 5, 6, 9)
_HEADS = (256, 16_384, MIB)  # bytes that a page header is looked for in: with long statistics it is long

# Kinds of values (thrift-compact-protocol, `Struct encoding`); parquet has no sets, maps and UUIDs
_TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _DOUBLE, _BINARY, _LIST, _, _, _STRUCT = range(1, 13)
_INTEGERS = (_I16, _I32, _I64)
_DEEPEST = 16


class _Chunk(NamedTuple):
    """One column of a row group, as the footer has it."""

    codec: int
    values: int
    start: int
    size: int  # packed [bytes]


class _Page(NamedTuple):
    kind: int
    start: int  # of its data in the file
    packed: int  # [bytes]
    unpacked: int  # [bytes]
    values: int
    encoding: int


def check_parquet(paths: Iterable[Path], columns: Sequence[str] | None = None, least: int = LARGEST_FILE) -> None:
    """Raise `ValueError` where columns (all by default) unpack to more than `least` and 100 times the files' size.

    Also for a page that does, for two columns of one name and for what is not a parquet file; `OSError` and pyarrow's
    errors for an unreadable one.
    """
    size = taken = 0
    names = None if columns is None else tuple(columns)
    for path in paths:
        there = path.stat()
        size += there.st_size
        taken += _unpacked_size(path, names, (there.st_ino, there.st_size, there.st_mtime_ns))
        if taken > max(least, _FILE_RATIO * size):
            raise ValueError(f"its columns unpack to {taken:,} bytes or more from {size:,}; no dataset unpacks so far")


@lru_cache(1_000)
def _unpacked_size(path: Path, columns: tuple[str, ...] | None, version: tuple[int, ...]) -> int:
    """The most that the columns' values take, unpacked [bytes]. version: of the file, so that it is read once."""
    with open(checks.open_regular(path), "rb") as stream:
        if stream.seek(0, 2) < 12:
            raise ValueError("it is not a parquet file")
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            footer = _footer(data)
            schema = pq.read_metadata(stream).schema  # which looks at no column's place or size
            count = len(schema.names)
            if count > MOST_COLUMNS:
                raise ValueError(f"it has {count:,} columns; expected at most {MOST_COLUMNS:,}")
            picture_columns(schema.to_arrow_schema())  # refuses what a reader would run
            if twice := [name for name, n in Counter(schema.to_arrow_schema().names).items() if n > 1]:
                raise ValueError(f"it has more than one column {twice[0][:100]!r}; expected different names")
            read = ("",) if columns is None else tuple(f"{column}." for column in columns)
            leaves = {i: schema.column(i) for i in range(count) if f"{schema.column(i).path}.".startswith(read)}
            widths = {i: _width(leaf) for i, leaf in leaves.items()}
            try:
                chunks = ((number, chunk) for number, chunk in _chunks(footer, count) if number in widths)
                return sum(_column_size(data, chunk, widths[number]) for number, chunk in chunks)
            except IndexError as error:
                raise ValueError("its footer is damaged") from error


def _width(column: Any) -> int | None:
    """The size of a column's values [bytes]; None for texts."""
    kind = column.physical_type
    return column.length if kind == "FIXED_LEN_BYTE_ARRAY" else _WIDTHS.get(kind)


def _footer(data: mmap.mmap) -> bytes:
    size = int.from_bytes(data[-8:-4], "little")
    if data[-4:] != _MAGIC or size > len(data) - 12:
        raise ValueError("it is not a parquet file")
    if size > LARGEST_FOOTER:
        raise ValueError(f"its footer has {size:,} bytes; expected at most {LARGEST_FOOTER:,}")
    return data[len(data) - 8 - size : len(data) - 8]


def _chunks(footer: bytes, columns: int) -> Iterator[tuple[int, _Chunk]]:
    """The columns of all row groups, each with its number in the schema."""
    groups, reader = 0, _Thrift(footer)
    for _ in reader.select(_ROW_GROUPS, _LIST):
        for _ in reader.elements():
            groups += 1
            if groups > MOST_GROUPS:
                raise ValueError(f"it has more than {MOST_GROUPS:,} row groups")
            for _ in reader.select(_COLUMNS, _LIST):
                for column, _ in enumerate(reader.elements()):
                    if column >= columns:
                        raise ValueError("a row group has more columns than the schema")
                    yield column, _chunk(reader)


def _chunk(reader: _Thrift) -> _Chunk:
    found: dict[int, int] = {}
    for _ in reader.select(_META_DATA, _STRUCT):
        found |= reader.integers(*_CHUNK_FIELDS)
    codec, values, size, start, dictionary = (found.get(field, 0) for field in _CHUNK_FIELDS)
    return _Chunk(codec, values, dictionary if 0 < dictionary < start else start, size)


def _column_size(data: mmap.mmap, chunk: _Chunk, width: int | None) -> int:
    """The most that one column of a row group takes [bytes]."""
    size = longest = 0
    for page in _pages(data, chunk):
        size += page.values * (_OVERHEAD if width is not None else _TEXT_OVERHEAD)
        if page.kind == _DICTIONARY:
            size += page.unpacked
            longest = page.unpacked if width is not None else _longest(data, page, chunk.codec)
        elif width is not None:
            size += page.values * width
        else:
            size += page.values * longest if page.encoding in _BY_DICTIONARY else page.unpacked
    return size


def _pages(data: mmap.mmap, chunk: _Chunk) -> Iterator[_Page]:
    """The pages that pyarrow would read. Raises `ValueError` for one that is not what it may be."""
    at, stop, seen = chunk.start, chunk.start + chunk.size, 0
    if not 0 < at <= stop <= len(data):
        raise ValueError("a column is outside the file")
    while seen < chunk.values and at < stop:
        page = _page(data, at, stop)
        if min(page.packed, page.unpacked, page.values) < 0 or page.start + page.packed > stop:
            raise ValueError("a page's header is damaged")
        most = max(LARGEST_PAGE, _PAGE_RATIO * page.packed)
        if page.unpacked > most:
            raise ValueError(f"a page of {page.packed:,} bytes unpacks to {page.unpacked:,}; expected at most {most:,}")
        if page.encoding not in _ENCODINGS and page.kind in (_DATA, _DATA_V2):
            name = "DELTA_BYTE_ARRAY" if page.encoding == _DELTA_BYTES else f"number {page.encoding}"
            problem = f"a page has the encoding {name}, which does not tell its size"
            raise ValueError(f"{problem}; write the file with another encoding")
        seen += page.values if page.kind != _DICTIONARY else 0
        at = page.start + page.packed
        yield page


def _page(data: mmap.mmap, at: int, stop: int) -> _Page:
    for window in _HEADS:
        reader = _Thrift(data[at : min(at + window, stop)])
        sizes, found = [-1, -1, -1], dict[int, int]()  # sizes: its type, unpacked and packed
        try:
            for number, kind in reader.fields():
                if 1 <= number <= len(sizes):
                    sizes[number - 1] = reader.integer(kind)
                elif number == _OWN_HEADER.get(sizes[0]) and kind == _STRUCT:
                    found = reader.integers(1, 2, 4)
                else:
                    reader.skip(kind)
        except IndexError:
            continue
        kind, unpacked, packed = sizes
        encoding = found.get(4 if kind == _DATA_V2 else 2, 0)
        values = found.get(1, -1) if kind in _OWN_HEADER else 0
        return _Page(kind, at + reader.at, packed, unpacked, values, encoding)
    raise ValueError("a page's header is damaged")


def _longest(data: mmap.mmap, page: _Page, codec: int) -> int:
    """The longest text in a dictionary [bytes]: what every value may be."""
    packed = data[page.start : page.start + page.packed]
    if codec not in (0, *_CODECS):
        return page.unpacked
    if codec:
        packed = pa.Codec(_CODECS[codec]).decompress(packed, page.unpacked, asbytes=True)
    at = longest = 0
    for _ in range(min(page.values, len(packed) // 4)):
        length = int.from_bytes(packed[at : at + 4], "little")
        longest, at = max(longest, length), at + 4 + length
    return min(longest, page.unpacked)


class _Thrift:
    """Values in compact Thrift, read from `at` on. Methods raise `IndexError` where the data ends before a value."""

    def __init__(self, data: bytes):
        self._data, self.at = data, 0

    def fields(self) -> Iterator[tuple[int, int]]:
        """Yield number and kind of a struct's fields; take or skip each one's value before the next."""
        number = 0
        while head := self._data[self.at]:
            self.at += 1
            number = number + (head >> 4) if head >> 4 else self.integer(_I16)
            yield number, head & 15
        self.at += 1

    def select(self, wanted: int, wanted_kind: int) -> Iterator[None]:
        """Stop at the value of a struct's field of this number and kind, to be taken; skip the other fields."""
        for number, kind in self.fields():
            if (number, kind) == (wanted, wanted_kind):
                yield
            else:
                self.skip(kind)

    def elements(self) -> Iterator[int]:
        """Yield the kind of a list's elements, once for each; take or skip each one before the next."""
        head = self._data[self.at]
        self.at += 1
        count = head >> 4 if head >> 4 < 15 else self._varint()
        for _ in range(count):
            yield head & 15

    def integers(self, *wanted: int) -> dict[int, int]:
        """Return a struct's wanted fields that are whole numbers, by their field's number."""
        found: dict[int, int] = {}
        for number, kind in self.fields():
            if number in wanted and kind in _INTEGERS:
                found[number] = self.integer(kind)
            else:
                self.skip(kind)
        return found

    def integer(self, kind: int) -> int:
        """Return a whole number; -1 for a value of another kind, which is skipped."""
        if kind not in _INTEGERS:
            self.skip(kind)
            return -1
        value = self._varint()
        return (value >> 1) ^ -(value & 1)

    def skip(self, kind: int, depth: int = 0, *, in_list: bool = False) -> None:
        """Skip a value. Raises `ValueError` for one of no known kind, or nested too deeply."""
        if kind in _INTEGERS:
            self._varint()
        elif kind in (_TRUE, _FALSE):
            self._move(int(in_list))
        elif kind in (_BYTE, _DOUBLE):
            self._move(1 if kind == _BYTE else 8)
        elif kind == _BINARY:
            self._move(self._varint())
        elif depth == _DEEPEST:
            raise ValueError("it is nested too deeply")
        elif kind == _LIST:
            for element in self.elements():
                self.skip(element, depth + 1, in_list=True)
        elif kind == _STRUCT:
            for _, field in self.fields():
                self.skip(field, depth + 1)
        else:
            raise ValueError(f"a value of kind {kind}")

    def _move(self, size: int) -> None:
        self.at += size
        if self.at > len(self._data):
            raise IndexError("it ends too early")

    def _varint(self) -> int:
        value = shift = 0
        while shift < 70:
            byte = self._data[self.at]
            self.at += 1
            value |= (byte & 127) << shift
            if byte < 128:
                return value
            shift += 7
        raise ValueError("a number of more than ten bytes")
