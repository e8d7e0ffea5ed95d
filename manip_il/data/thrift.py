"""Compact Thrift, as far as parquet's footers and page headers need it (thrift-compact-protocol, `Struct encoding`).

pyarrow ends the whole process where it meets some damaged footers; here nothing but `ValueError` and `IndexError` comes
of any bytes.
"""

from __future__ import annotations

from collections.abc import Iterator

_TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _DOUBLE, _BINARY, _LIST, _SET, _MAP, STRUCT, _UUID = range(1, 14)
LIST = _LIST
_INTEGERS = (_I16, _I32, _I64)
_DEEPEST = 16


class Thrift:
    """Reads values from `at` on, which moves on. Methods raise `IndexError` where the data ends before a value."""

    def __init__(self, data: bytes, at: int = 0):
        self._data, self.at = data, at

    def fields(self) -> Iterator[tuple[int, int]]:
        """Yield number and kind of a struct's fields; take or skip each one's value before the next."""
        number = 0
        while head := self._data[self.at]:
            self.at += 1
            number = number + (head >> 4) if head >> 4 else self._integer()
            yield number, head & 15
        self.at += 1

    def elements(self) -> Iterator[int]:
        """Yield the kind of a list's elements, once for each; take or skip each one before the next."""
        head = self._data[self.at]
        self.at += 1
        count = head >> 4 if head >> 4 < 15 else self._varint()
        for _ in range(count):
            yield head & 15

    def integers(self, *wanted: int) -> dict[int, int]:
        """Return a struct's whole numbers by their field's number, those that are there."""
        found: dict[int, int] = {}
        for number, kind in self.fields():
            if number in wanted and kind in _INTEGERS:
                found[number] = self._integer()
            else:
                self.skip(kind)
        return found

    def integer(self, kind: int) -> int:
        """Return a whole number; -1 for a value of another kind, which is skipped."""
        if kind in _INTEGERS:
            return self._integer()
        self.skip(kind)
        return -1

    def skip(self, kind: int, depth: int = 0, *, in_list: bool = False) -> None:
        """Move on behind a value. Raises `ValueError` for one of no kind, or nested too deeply."""
        if kind in _INTEGERS:
            self._varint()
        elif kind in (_TRUE, _FALSE):
            self._move(int(in_list))
        elif kind in (_BYTE, _DOUBLE, _UUID):
            self._move({_BYTE: 1, _DOUBLE: 8, _UUID: 16}[kind])
        elif kind == _BINARY:
            self._move(self._varint())
        elif depth == _DEEPEST:
            raise ValueError("it is nested too deeply")
        elif kind in (_LIST, _SET):
            for element in self.elements():
                self.skip(element, depth + 1, in_list=True)
        elif kind == STRUCT:
            for _, field in self.fields():
                self.skip(field, depth + 1)
        elif kind == _MAP:
            self._skip_map(depth)
        else:
            raise ValueError(f"a value of kind {kind}")

    def _skip_map(self, depth: int) -> None:
        if count := self._varint():
            kinds = self._data[self.at]
            self.at += 1
            for _ in range(count):
                self.skip(kinds >> 4, depth + 1, in_list=True)
                self.skip(kinds & 15, depth + 1, in_list=True)

    def _move(self, size: int) -> None:
        self.at += size
        if self.at > len(self._data):
            raise IndexError("it ends too early")

    def _integer(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)

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
