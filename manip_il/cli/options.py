"""Options of commands: what a dataclass of options holds, which values a type accepts, and what help calls them.

A field's type is int, float, bool, str, Path, a `Literal` of names, a list of those, one of those or None, a class with
`parse` and `str` (`linear:5`), another dataclass (a group, `--dataset.root`), or `Open`: a group of which only another
program knows the options (`--policy.*`), as a dict of whatever was given. `given(Config)` is a group of a class's own
options, as a dict of those that were given: what makes the class, with what else it takes.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import shlex
import sys
import types
import typing
from collections.abc import Collection, Mapping
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any, Literal, Union

from manip_il.checks import parse_yaml

Open = dict[str, Any]  # option -> value as YAML reads it
Given = dict[str, Any]  # field -> value
_EXPECTED = {int: "a whole number", float: "a number", bool: "true or false", Path: "a path", Any: "YAML"}
_METAVARS = {int: "INT", float: "FLOAT", bool: "true|false", str: "TEXT", Path: "PATH"}


def group(default: Any, prefix: str | None = None) -> Any:
    """Return a field of nested options. prefix: before their names, in place of the field's own name and a dot."""
    metadata = {} if prefix is None else {"prefix": prefix}
    return field(default_factory=functools.partial(dataclasses.replace, default), metadata=metadata)


def given(cls: type, prefix: str | None = None, only: Collection[str] = (), **own: Any) -> Any:
    """Return a `Given` field: every option of `cls`, declared there.

    only: fields, if not all. own: values in place of the defaults of `cls`, which are held, too.
    """
    metadata = {"given": cls, "only": only}
    names = {} if prefix is None else {"prefix": prefix}
    return field(default_factory=functools.partial(dict, own), metadata=metadata | names)


@dataclass(frozen=True)
class Option:
    """One option of a command. `default` is `MISSING` if the user must give a value.

    path: the attributes and keys that lead from the command's options to its value. metadata: of its field: `help`, one
    line; `positional` for a value without a name; `command_line_only` for one that no file may set; `exists` for a path
    to read: what it is on the Hub (`datasets/`); `flag`, its whole name; `at_least` and `at_most`. home: the class that
    declares it.
    """

    name: str  # dotted: `dataset.root`
    path: tuple[str, ...]
    type: Any
    default: Any
    metadata: Mapping[str, Any]
    home: type

    @property
    def positional(self) -> bool:
        """Whether its value stands without a name."""
        return self.metadata.get("positional", False)

    @property
    def label(self) -> str:
        """Name as the user writes it."""
        if self.positional:
            return f"{self.name.upper()}..." if self.is_list else self.name.upper()
        return f"--{self.name}.NAME" if self.is_open else f"--{self.name}"

    @property
    def is_list(self) -> bool:
        """Whether it takes several values."""
        return typing.get_origin(self.type) is list

    @property
    def is_open(self) -> bool:
        """Whether it stands for any number of options, of which only another program knows the names."""
        return typing.get_origin(self.type) in (dict, Mapping)

    def value(self, options: Any) -> Any:
        """Return its value in a command's options."""
        for key in self.path:
            options = options.get(key, self.default) if isinstance(options, dict) else getattr(options, key)
        return {} if self.is_open and options in (None, MISSING) else options


def options_of(cls: type, base: Any = None, prefix: str = "", path: tuple[str, ...] = ()) -> list[Option]:
    """Return every option of a dataclass, groups resolved, those that classes share last. base: has the defaults."""
    found: list[Option] = []
    for one in sorted(dataclasses.fields(cls), key=lambda one: one.kw_only is True):
        inner, here = one.metadata.get("prefix", f"{prefix}{one.name}."), (*path, one.name)
        (home, kind), default = declared(cls, one), default_of(one, base)
        if source := one.metadata.get("given"):
            for theirs in dataclasses.fields(source):
                if "help" in theirs.metadata and theirs.name in (one.metadata["only"] or (theirs.name,)):
                    name = theirs.metadata.get("flag", inner + theirs.name)
                    own, where = default.get(theirs.name, default_of(theirs)), (*here, theirs.name)
                    home, kind = declared(source, theirs)
                    found.append(Option(name, where, kind, own, theirs.metadata, home))
        elif dataclasses.is_dataclass(kind):
            found += options_of(typing.cast(type, kind), None if default is MISSING else default, inner, here)
        else:
            found.append(Option(one.metadata.get("flag", prefix + one.name), here, kind, default, one.metadata, home))
    return found


def default_of(one: dataclasses.Field[Any], base: Any = None) -> Any:
    """Return a field's value in `base`, else its default, else `MISSING`."""
    if base is not None:
        return getattr(base, one.name)
    return one.default if one.default_factory is MISSING else one.default_factory()


def declared(cls: type, one: dataclasses.Field[Any]) -> tuple[type, Any]:
    """Return the class that declares a field, and the field's type; others' may be known to type checkers alone."""
    home = next(base for base in cls.__mro__ if one.name in vars(base).get("__annotations__", {}))
    return home, eval(one.type, vars(sys.modules[home.__module__])) if isinstance(one.type, str) else one.type


def to_plain(options: Any) -> dict[str, Any]:
    """Return a command's options as a tree of dicts, lists, text, numbers, booleans and None, by their names."""
    tree: dict[str, Any] = {}
    for one in options_of(type(options)):
        if not one.metadata.get("command_line_only"):
            *groups, last = one.name.split(".")
            place = functools.reduce(lambda inner, name: inner.setdefault(name, {}), groups, tree)
            place[last] = _plain(one.value(options))
    return tree


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) or hasattr(value, "parse") else value


def command_line(name: str, options: Any) -> str:
    """Return the command with every option that is not its default, to copy."""
    words = ["manip-il", *name.split()]
    for one in options_of(type(options)):
        value = one.value(options)
        if one.positional:
            words += map(str, value if isinstance(value, list) else [] if value is None else [value])
        elif one.is_open:
            texts = {key: text if isinstance(text, str) else json.dumps(text) for key, text in value.items()}
            words += [f"--{one.name}.{key}={text}" for key, text in texts.items()]
        elif value != one.default and one.name not in ("resume", "overwrite"):
            words.append(f"--{one.name}={word(value)}")
    return shlex.join(words)


def word(value: Any) -> str:
    """Return a value as it stands on the command line."""
    plain = _plain(value)
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
    return f"one of {', '.join(named)}" if named else _EXPECTED.get(option_type, "text")


def from_word(option_type: Any, word: str) -> Any:
    """Return a word of the command line as YAML would give it: `null`, and commas of a list, have a meaning."""
    if (some := without_none(option_type)) is not option_type:
        return None if word.lower() in ("null", "none") else from_word(some, word)
    if typing.get_origin(option_type) is not list:
        return word
    inner = word[1:-1] if word.startswith("[") and word.endswith("]") else word
    return [item.strip().strip("'\"") for item in inner.split(",")] if inner.strip() else []


def decode(option_type: Any, value: Any) -> Any:
    """Return `value`, as YAML gives it or as text, as the declared type; raises one of several errors if it is none.

    Draccus takes a boolean for a number or text, NaN for a number and nothing for the current folder, which is refused.
    """
    import draccus  # here, as help needs no YAML

    some = without_none(option_type)
    if option_type is Any:
        return parse_yaml(value)
    if hasattr(some, "parse") and isinstance(value, str):
        return some.parse(value)
    if some == list[Path] and isinstance(value, str):
        value = [value]
    decoded: Any = draccus.decode(option_type, value)
    if decoded != decoded or (isinstance(value, bool) and some is not bool) or (some is Path and value == ""):
        raise ValueError
    return [_expand(item) for item in decoded] if isinstance(decoded, list) else _expand(decoded)


def _expand(value: Any) -> Any:
    return value.expanduser() if isinstance(value, Path) else value  # a shell leaves the tilde of `--root=~/x` alone


def without_none(option_type: Any) -> Any:
    """Return `X` of `X | None`, and any other type as it is."""
    if typing.get_origin(option_type) not in (Union, types.UnionType):
        return option_type
    return next(member for member in typing.get_args(option_type) if member is not types.NoneType)


def choices(option_type: Any) -> tuple[str, ...]:
    """Return the names of a `Literal`, also of one or None; none for any other type."""
    option_type = without_none(option_type)
    return typing.get_args(option_type) if typing.get_origin(option_type) is Literal else ()
