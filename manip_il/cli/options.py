"""Options of commands: what a dataclass of options holds, which values a type accepts, and what help calls them.

A field's type is int, float, bool, str, Path, a `Literal` of names, a list of those, one of those or None, another
dataclass (a group, `--dataset.root`), or `Open`: a group of which only another program knows the options
(`--policy.*`), as a dict of whatever was given.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import shlex
import types
import typing
from collections.abc import Iterator
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any, Literal, Union

Open = dict[str, Any]  # option -> value as YAML reads it
_EXPECTED = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}
_METAVARS = {int: "INT", float: "FLOAT", bool: "true|false", str: "TEXT", Path: "PATH"}


@dataclass(frozen=True)
class Option:
    """One option of a command. `default` is `MISSING` where the user must give a value."""

    name: str  # dotted: `dataset.root`
    type: Any
    default: Any
    help: str
    positional: bool

    @property
    def label(self) -> str:
        """Name as the user writes it."""
        if self.is_open:
            return f"--{self.name}.NAME"
        if self.positional:
            return f"{self.name.upper()}..." if self.is_list else self.name.upper()
        return f"--{self.name}"

    @property
    def is_list(self) -> bool:
        """Whether it takes several values."""
        return typing.get_origin(self.type) is list

    @property
    def is_open(self) -> bool:
        """Whether it stands for any number of options, of which only another program knows the names."""
        return self.type == Open


def options_of(cls: type, base: Any = None, prefix: str = "") -> list[Option]:
    """Return every option of a dataclass, groups resolved, in the order of definition.

    field metadata: `help`, one line; `positional=True` for a value without a name (`manip-il data check DATASET`);
    `command_line_only=True` for an option that no file may set, and that no file of options holds.
    """
    found: list[Option] = []
    for field, field_type, default in fields_of(cls, base):
        name = prefix + field.name
        if dataclasses.is_dataclass(field_type):
            found += options_of(typing.cast(type, field_type), None if default is MISSING else default, f"{name}.")
        else:
            help_text, positional = field.metadata.get("help", ""), field.metadata.get("positional", False)
            found.append(Option(name, field_type, default, help_text, positional))
    return found


def fields_of(cls: type, base: Any) -> Iterator[tuple[dataclasses.Field[Any], Any, Any]]:
    """Yield every field that a dataclass's constructor takes, its type, and its value in `base`, else its default."""
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        own = field.default if field.default_factory is MISSING else field.default_factory()
        if field.init:
            yield field, hints[field.name], own if base is None else getattr(base, field.name)


def value_of(options: Any, name: str) -> Any:
    """Return the value of an option by its dotted name."""
    return functools.reduce(getattr, name.split("."), options)


def to_plain(value: Any) -> Any:
    """Return options as dicts, lists, text, numbers, booleans and None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [f for f in dataclasses.fields(value) if f.init and not f.metadata.get("command_line_only")]
        return {f.name: to_plain(getattr(value, f.name)) for f in fields}
    if isinstance(value, dict):
        return {key: to_plain(item) for key, item in value.items()}
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    return value


def command_line(name: str, options: Any) -> str:
    """Return the command with every option that is not its default, to copy."""
    words = ["manip-il", *name.split()]
    for known in options_of(type(options)):
        value = value_of(options, known.name)
        if known.positional:
            words += map(str, value if isinstance(value, list) else [value])
        elif known.is_open:
            given = {key: one if isinstance(one, str) else json.dumps(one) for key, one in value.items()}
            words += [f"--{known.name}.{key}={one}" for key, one in given.items()]
        elif (known.default is MISSING or value != known.default) and known.name not in ("resume", "overwrite"):
            words.append(f"--{known.name}={word(value)}")
    return shlex.join(words)


def word(value: Any) -> str:
    """Return a value as it stands on the command line."""
    plain = to_plain(value)
    if isinstance(plain, list):
        return ",".join(map(str, plain))
    return json.dumps(plain) if plain is None or isinstance(plain, bool) else str(plain)


def metavar(option_type: Any) -> str:
    """Return what stands for the value in the help: `INT`, `PATH`, `mse|l1`, `FLOAT,...`."""
    option_type = without_none(option_type)
    if typing.get_origin(option_type) is list:
        return f"{metavar(typing.get_args(option_type)[0])},..."
    return "|".join(choices(option_type)) or _METAVARS.get(option_type, "VALUE")


def expected(option_type: Any) -> str:
    """Return what an error message asks for."""
    if (some := without_none(option_type)) is not option_type:
        return f"{expected(some)} or null"
    if typing.get_origin(option_type) is list:
        return f"a comma-separated list, each {expected(typing.get_args(option_type)[0])}"
    named = choices(option_type)
    return f"one of {', '.join(named)}" if named else _EXPECTED[option_type]


def decode(option_type: Any, value: Any, *, is_word: bool = False) -> Any:
    """Return `value` as the declared type; `ValueError` where it is none. is_word: `null` and commas have a meaning."""
    if (some := without_none(option_type)) is not option_type:
        is_none = value is None or (is_word and value.lower() in ("null", "none"))
        return None if is_none else decode(some, value, is_word=is_word)
    if typing.get_origin(option_type) is list:
        if is_word:
            inner = value[1:-1] if value.startswith("[") and value.endswith("]") else value
            value = [item.strip().strip("'\"") for item in inner.split(",")] if inner.strip() else []
            if "" in value:
                raise ValueError
        item_type = typing.get_args(option_type)[0]
        if item_type is Path and isinstance(value, str):
            value = [value]  # in YAML one path stands for a list of one
        if not isinstance(value, list):
            raise ValueError
        return [decode(item_type, item) for item in value]
    if named := choices(option_type):
        if value not in named:
            raise ValueError
        return value
    return _decode_scalar(option_type, value)


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


def without_none(option_type: Any) -> Any:
    """Return `X` of `X | None`, and any other type as it is."""
    if typing.get_origin(option_type) not in (Union, types.UnionType):
        return option_type
    return next(member for member in typing.get_args(option_type) if member is not types.NoneType)


def choices(option_type: Any) -> tuple[str, ...]:
    """Return the names of a `Literal`, also of one or None; none for any other type."""
    option_type = without_none(option_type)
    return typing.get_args(option_type) if typing.get_origin(option_type) is Literal else ()
