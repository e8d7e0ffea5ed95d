"""The values of options: what a declared type accepts, and what it is called in help and errors.

Types: int, float, bool, str, Path, a `Literal`, an `Enum` (by name), a list of those, a union of those or with None.
"""

from __future__ import annotations

import types
import typing
from enum import Enum
from pathlib import Path
from typing import Any, Literal, Union

_EXPECTED = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}
_METAVARS = {int: "INT", float: "FLOAT", bool: "true|false", str: "TEXT", Path: "PATH"}


def metavar(option_type: Any) -> str:
    """What stands for the value in the help: `INT`, `PATH`, `mse|l1`, `FLOAT,...`."""
    if typing.get_origin(option_type) is list:
        return f"{metavar(typing.get_args(option_type)[0])},..."
    if members := _union_members(option_type):
        return "|".join(metavar(member) for member in members if member is not types.NoneType)
    if named := choices(option_type):
        return "|".join(named)
    return _METAVARS.get(option_type, "VALUE")


def expected(option_type: Any) -> str:
    """What an error message asks for."""
    if typing.get_origin(option_type) is list:
        return f"a comma-separated list, each {expected(typing.get_args(option_type)[0])}"
    if members := _union_members(option_type):
        return " or ".join("null" if member is types.NoneType else expected(member) for member in members)
    if named := choices(option_type):
        return f"one of {', '.join(named)}"
    return _EXPECTED[option_type]


def decode(option_type: Any, value: Any, *, is_word: bool = False) -> Any:
    """`value` as the declared type, or `ValueError`. `is_word`: `null` and commas have their meaning."""
    if members := _union_members(option_type):
        return _decode_union(members, value, is_word)
    if typing.get_origin(option_type) is list:
        if is_word:
            inner = value[1:-1] if value.startswith("[") and value.endswith("]") else value
            value = [item.strip().strip("'\"") for item in inner.split(",")] if inner.strip() else []
            if "" in value:
                raise ValueError
        if not isinstance(value, list):
            raise ValueError
        item_type = typing.get_args(option_type)[0]
        return [decode(item_type, item) for item in value]
    if named := choices(option_type):
        return _decode_choice(option_type, named, value)
    return _decode_scalar(option_type, value)


def _decode_union(members: tuple[Any, ...], value: Any, is_word: bool) -> Any:
    if types.NoneType in members and (value is None or (is_word and value.lower() in ("null", "none"))):
        return None
    for member in members:
        if member is not types.NoneType:
            try:
                return decode(member, value, is_word=is_word)
            except ValueError:
                continue
    raise ValueError


def _decode_choice(option_type: Any, named: dict[str, Any], value: Any) -> Any:
    if isinstance(value, str) and value in named:
        return named[value]
    if isinstance(option_type, type):  # an Enum, by its value
        return option_type(value)
    for choice in named.values():
        if type(choice) is type(value) and choice == value:
            return choice
    raise ValueError


def _decode_scalar(option_type: Any, value: Any) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if option_type is bool:
        if isinstance(value, bool):
            return value
        if value in ("true", "false"):
            return value == "true"
    elif option_type is int and (isinstance(value, str) or (is_number and isinstance(value, int))):
        return int(value)
    elif option_type is float and (isinstance(value, str) or is_number):
        number = float(value)
        if number == number:  # NaN would slip through every range check
            return number
    elif option_type is str and isinstance(value, str):
        return value
    elif option_type is Path and isinstance(value, str) and value:
        # A shell leaves the tilde of `--root=~/x` alone.
        return Path(value).expanduser() if value == "~" or value.startswith("~/") else Path(value)
    raise ValueError


def _union_members(option_type: Any) -> tuple[Any, ...]:
    return typing.get_args(option_type) if typing.get_origin(option_type) in (Union, types.UnionType) else ()


def choices(option_type: Any) -> dict[str, Any]:
    """Name -> value of a `Literal` or an `Enum`, also within a union; empty for any other type."""
    if members := _union_members(option_type):
        return {name: value for member in members for name, value in choices(member).items()}
    if typing.get_origin(option_type) is Literal:
        return {str(choice): choice for choice in typing.get_args(option_type)}
    if isinstance(option_type, type) and issubclass(option_type, Enum):
        return dict(option_type.__members__)
    return {}
