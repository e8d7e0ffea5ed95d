"""Check what is read from outside (JSON, YAML, names that become paths, numbers, text) where its type is made.

Every check returns the value with its declared type, or raises `ManipError` with one short line that names the thing,
its value and what was expected. Values are printed shortened, so that a hostile one can neither flood a terminal nor
take time to print.
"""

from __future__ import annotations

import functools
import json
import math
import re
import reprlib
import sys
from pathlib import Path
from typing import Any

from manip_il.errors import ManipError, UsageError

LONGEST_NAME = 100  # [characters]
LONGEST_TEXT = 10_000  # [characters]
LARGEST_JSON = 256 * 1024 * 1024  # [bytes]; an eval.json of half a million episodes
LARGEST_YAML = 256 * 1024  # [bytes]: the parser takes a second for 100 kB
DEEPEST_YAML = 50  # levels
LARGEST_SEED = 2**63 - 1  # datasets store seeds as int64

_NAME = re.compile(r"[A-Za-z0-9_\-][A-Za-z0-9_.\-]*")
_LONGEST_WHY = 300  # of a parser's message [characters]
_LONGEST_PRINTED = 300  # [characters]
_PRINTED = reprlib.Repr()
_PRINTED.maxstring = _PRINTED.maxother = _PRINTED.maxlong = 80
_PRINTED.maxlevel = 2
_PRINTED.maxlist = _PRINTED.maxtuple = _PRINTED.maxdict = _PRINTED.maxset = 4


def shorten(value: object) -> str:
    """Return `repr(value)` in at most 300 characters, whatever the value is."""
    try:
        printed = _PRINTED.repr(value)
    except ValueError:  # an int of more digits than Python prints
        printed = f"a huge {type(value).__name__}"
    return printed if len(printed) <= _LONGEST_PRINTED else f"{printed[: _LONGEST_PRINTED - 3]}..."


def name(what: str, value: object) -> str:
    """Return a name that may become part of a path: letters, digits and `_ . -`, at most 100 characters.

    A dot may not come first, and `..` nowhere.
    """
    if not isinstance(value, str) or not _NAME.fullmatch(value) or len(value) > LONGEST_NAME or ".." in value:
        raise ManipError(
            f"{what} is {shorten(value)}; expected a name of letters, digits and _ . - (no '..', no dot first, at most "
            f"{LONGEST_NAME} characters)"
        )
    return value


def repo_id(what: str, value: object) -> str:
    """Return a dataset's or policy's id, `NAME` or `USER/NAME`, both parts as `name` has them."""
    parts = value.split("/") if isinstance(value, str) else []
    if not 1 <= len(parts) <= 2:
        raise ManipError(f"{what} is {shorten(value)}; expected USER/NAME")
    for part in parts:
        name(what, part)
    return "/".join(parts)


def text(what: str, value: object, longest: int = LONGEST_TEXT) -> str:
    """Return a string of at most `longest` characters."""
    if not isinstance(value, str) or len(value) > longest:
        raise ManipError(f"{what} is {shorten(value)}; expected text of at most {longest} characters")
    return value


def truth(what: str, value: object) -> bool:
    """Return a bool; 0, 1 and "true" are none."""
    if not isinstance(value, bool):
        raise ManipError(f"{what} is {shorten(value)}; expected true or false")
    return value


def whole(what: str, value: object, low: int, high: int) -> int:
    """Return an int within [low, high]; True and 3.0 are none."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ManipError(f"{what} is {shorten(value)}; expected a whole number from {low} to {high}")
    return value


def number(what: str, value: object, low: float = -math.inf, high: float = math.inf) -> float:
    """Return a finite float within [low, high]."""
    if isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high and _is_float(value):
        return float(value)
    limits = "" if math.isinf(low) and math.isinf(high) else f" from {low:g} to {high:g}"
    raise ManipError(f"{what} is {shorten(value)}; expected a finite number{limits}")


def array(what: str, value: object, longest: int = 1_000_000) -> list[Any]:
    """Return a list of at most `longest` values."""
    if not isinstance(value, list | tuple) or len(value) > longest:
        raise ManipError(f"{what} is {shorten(value)}; expected a list of at most {longest}")
    return list(value)


def mapping(what: str, value: object) -> dict[str, Any]:
    """Return a dict whose keys are text."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise ManipError(f"{what} is {shorten(value)}; expected an object of named values")
    return value


def parse_json(what: str, data: str | bytes, *, nan_is_none: bool = False) -> Any:
    """Return what a JSON text holds; broken, too deep, or with NaN or Infinity, it is refused.

    nan_is_none: NaN and Infinity are read as None instead.
    """
    try:
        return json.loads(data, parse_constant=_to_none if nan_is_none else _refuse_constant)
    except RecursionError as error:
        raise ManipError(f"{what} is not valid JSON: it is nested too deeply") from error
    except ValueError as error:  # UnicodeDecodeError and JSONDecodeError are
        raise ManipError(f"{what} is not valid JSON: {error}") from error


def read_json(path: Path, what: str, largest: int = LARGEST_JSON) -> dict[str, Any]:
    """Return the object in a JSON file of at most `largest` bytes. what: the file should be, for the message."""
    return mapping(str(path), parse_json(str(path), read_bytes(path, what, largest)))


def read_bytes(path: Path, what: str, largest: int, refusal: type[ManipError] = ManipError) -> bytes:
    """Return a file's content; raises `refusal` for more than `largest` bytes and for what cannot be read."""
    try:
        with path.open("rb") as file:
            data = file.read(largest + 1)
    except OSError as error:
        raise refusal(f"cannot read {path}: {error.strerror}; expected {what}") from error
    if len(data) > largest:
        raise refusal(f"{path} has more than {largest} bytes; expected {what}")
    return data


def _is_float(value: float) -> bool:
    """Whether a number is finite and no int beyond what a float holds."""
    return abs(value) <= sys.float_info.max


def _to_none(constant: str) -> None:
    return None


def _refuse_constant(constant: str) -> Any:
    raise ValueError(f"{constant} is not a number in JSON")


def parse_yaml(text: str) -> Any:
    """Return what a YAML text holds. Raises `ValueError`, in one line, for what is none, has aliases or is too deep."""
    import yaml  # here, as most of what checks something reads no YAML

    try:
        return yaml.load(text, _loader())
    except Exception as error:  # besides its own errors it raises whatever int() or datetime() do
        raise ValueError(" ".join(str(error).split())[:_LONGEST_WHY]) from error


def read_yaml(path: Path, what: str) -> Any:
    """Return what is in a file; `UsageError` where it cannot be read. what: the file should be, for the message."""
    data = read_bytes(path, what, LARGEST_YAML, UsageError)
    try:
        return parse_yaml(data.decode())
    except ValueError as error:  # UnicodeDecodeError is one
        raise UsageError(f"{path} is not YAML: {error}") from error


@functools.cache
def _loader() -> Any:
    """Return a loader without tags that run code, and without aliases, which can grow beyond any memory."""
    import yaml

    class Loader(yaml.SafeLoader):
        _depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError(
                    f"an alias (*) in line {self.peek_event().start_mark.line + 1}; write the value out"
                )
            self._depth += 1
            if self._depth > DEEPEST_YAML:
                raise yaml.YAMLError(f"nested deeper than {DEEPEST_YAML} levels")
            node = super().compose_node(parent, index)
            self._depth -= 1
            return node

    return Loader
