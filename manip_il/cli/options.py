"""Dataclasses of options, read from `--a.b=c` words and YAML in LeRobot's style.

Words beat YAML beats defaults. A group of which only another program knows the options (`--policy.*`) is a field of
type `Open`: a dict of whatever was given.

The parser is our own, as draccus cannot be taught to answer with one line: it exits through argparse, turns a range
error of a nested dataclass into a decoding error, takes `true` for a number, and loads YAML with tags that read other
files.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from manip_il import __version__
from manip_il.checks import shorten
from manip_il.cli.mistakes import unexpected_word, unknown_option
from manip_il.cli.values import choices, decode, expected
from manip_il.errors import UsageError, nearest

Open = dict[str, Any]  # option -> value as YAML reads it
CONFIG_PATH = "config_path"  # LeRobot's name for the option that reads YAML
CONFIG_HEADER = "# manip-il"  # how every file from `dump_yaml` begins


@dataclass(frozen=True)
class Option:
    """One leaf of a dataclass of options. `default` is `MISSING` where the user must give a value."""

    name: str  # dotted: `dataset.root`
    type: Any
    default: Any
    help: str
    positional: bool

    @property
    def label(self) -> str:
        """How the user writes it."""
        if self.is_open:
            return f"--{self.name}.NAME"
        if self.positional:
            return f"{self.name.upper()}..." if typing.get_origin(self.type) is list else self.name.upper()
        return f"--{self.name}"

    @property
    def is_open(self) -> bool:
        """Whether it stands for any number of options, of which only another program knows the names."""
        return self.type == Open


@dataclass(frozen=True)
class _Given:
    """A value as the user gave it, and where, for the error message."""

    value: Any
    where: str
    is_word: bool  # from the command line, where everything is text


def options_of(cls: type, base: Any = None, prefix: str = "") -> list[Option]:
    """Return every option of a dataclass, depth first, in the order of definition.

    field metadata: `help`, one line; `positional=True` for a value without a name (`manip-il doctor DATASET`);
    `command_line_only=True` for what no file may say, and none that is written does.
    """
    found: list[Option] = []
    for field, field_type in _fields(cls):
        name, default = prefix + field.name, _default(field, base)
        if dataclasses.is_dataclass(field_type):
            found += options_of(typing.cast(type, field_type), None if default is MISSING else default, f"{name}.")
        else:
            help_text, positional = field.metadata.get("help", ""), field.metadata.get("positional", False)
            found.append(Option(name, field_type, default, help_text, positional))
    return found


def parse[T](cls: type[T], words: Sequence[str], command: str = "") -> T:
    """Options from the command line; `UsageError` for an unknown name, a bad or a missing value.

    command: whose options they are, for the message.
    """
    known = {option.name: option for option in options_of(cls)}
    from_words, config_paths = _read_words(words, known, command)
    from_files: dict[str, _Given] = {}
    for path in config_paths:
        from_files |= _read_yaml(Path(path), cls, known)
    return _build(cls, from_files | from_words)


def from_yaml[T](path: Path, cls: type[T]) -> T:
    """Options from a YAML file of differences, or from one that `dump_yaml` wrote."""
    known = {option.name: option for option in options_of(cls)}
    return _build(cls, _read_yaml(path, cls, known))


def from_layers[T](cls: type[T], layers: Sequence[tuple[str, Mapping[str, Any]]]) -> T:
    """Options from trees of differences, as YAML reads them; of two that say the same option, the later one counts.

    layers: where a tree is from, for error messages, and the tree. `UsageError` as from a YAML file.
    """
    known = {option.name: option for option in options_of(cls)}
    given: dict[str, _Given] = {}
    for where, tree in layers:
        given |= {name: _Given(value, f"{where}: {name}", False) for name, value in _leaves(tree, known, where)}
    return _build(cls, given)


def dump_yaml(options: Any) -> str:
    """Return the resolved options as YAML: `from_yaml` gives them back equal."""
    import yaml

    header = f"{CONFIG_HEADER} {__version__}: resolved options ({type(options).__name__})\n"
    return header + yaml.safe_dump(to_plain(options), sort_keys=False)


def to_plain(value: Any) -> Any:
    """Options as dicts, lists, text, numbers, booleans and None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [f for f in dataclasses.fields(value) if f.init and not f.metadata.get("command_line_only")]
        return {f.name: to_plain(getattr(value, f.name)) for f in fields}
    if isinstance(value, dict):
        return {key: to_plain(item) for key, item in value.items()}
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    return value


def _read_words(words: Sequence[str], known: Mapping[str, Option], command: str) -> tuple[dict[str, _Given], list[str]]:
    given: dict[str, _Given] = {}
    config_paths: list[str] = []
    places = [option for option in known.values() if option.positional]
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if not word.startswith("--"):
            if not places:
                raise unexpected_word(word, known, command)
            option = places[0] if typing.get_origin(places[0].type) is list else places.pop(0)
            _place(word, option, given)
            continue
        name, equals, value = word[2:].partition("=")
        if name not in known and name.replace("-", "_") in known:  # as other programs write it
            name = name.replace("-", "_")
        if group := _open_group(name, known):
            if not equals and (not rest or rest[0].startswith("--")):
                raise UsageError(f"--{name} has no value; expected --{name}=VALUE")
            given[name] = _Given(_as_yaml(value if equals else rest.pop(0), group), f"--{name}", False)
            continue
        if name != CONFIG_PATH and (name not in known or known[name].positional or known[name].is_open):
            raise unknown_option("option", name, known, "--", command)
        if not equals:
            value = _next_value(name, known, rest)
        if name == CONFIG_PATH:
            config_paths.append(value)
        else:
            given[name] = _Given(value, f"--{name}", True)
    return given, config_paths


def _place(word: str, option: Option, given: dict[str, _Given]) -> None:
    """Give an option without a name its value; a list takes every word that is left."""
    if typing.get_origin(option.type) is not list:
        given[option.name] = _Given(word, option.label, True)
        return
    before = given[option.name].value if option.name in given else []
    given[option.name] = _Given([*before, word], option.label, False)


def _open_group(name: str, known: Mapping[str, Option]) -> str:
    """The open group that `name` is an option of, or nothing."""
    if name in known:
        return ""
    return next((option.name for option in known.values() if option.is_open and name.startswith(f"{option.name}.")), "")


def _as_yaml(word: str, group: str) -> Any:
    from manip_il.yaml_file import parse_yaml

    try:
        return parse_yaml(word)
    except ValueError as error:
        raise UsageError(f"--{group}: {shorten(word)} is not a YAML value: {error}") from error


def _next_value(name: str, known: Mapping[str, Option], rest: list[str]) -> str:
    """Take the value of `--name value` from `rest`; a flag without one is true."""
    if name in known and known[name].type is bool and not (rest and rest[0] in ("true", "false")):
        return "true"
    if not rest or rest[0].startswith("--"):
        wanted = expected(known[name].type) if name in known else "a path"
        raise UsageError(f"--{name} has no value; expected {wanted}")
    return rest.pop(0)


def _read_yaml(path: Path, cls: type, known: Mapping[str, Option]) -> dict[str, _Given]:
    from manip_il.yaml_file import read_yaml

    tree = read_yaml(path, "a YAML file of options")
    if not isinstance(tree, dict | None):
        raise UsageError(f"{path} holds {type(tree).__name__}; expected a mapping of option names to values")
    return {name: _Given(value, f"{path}: {name}", False) for name, value in _leaves(tree or {}, known, path)}


def _leaves(
    tree: Mapping[Any, Any], known: Mapping[str, Option], path: Path | str, prefix: str = ""
) -> Iterator[tuple]:
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if name in known and known[name].is_open:
            if not isinstance(value, dict | None):
                raise UsageError(f"{path}: {name}: expected a mapping of options, got {shorten(value)}")
            yield from ((f"{name}.{inner}", one) for inner, one in (value or {}).items())
        elif name in known or _open_group(name, known):
            yield name, value
        elif not any(option.startswith(f"{name}.") for option in known):
            raise unknown_option(f"key in {path}:", name, known, "", "")
        elif isinstance(value, dict):
            yield from _leaves(value, known, path, f"{name}.")
        elif value is not None:
            raise UsageError(f"{path}: {name}: expected a mapping of options, got {shorten(value)}")


def _build[T](cls: type[T], given: Mapping[str, _Given], base: Any = None, prefix: str = "") -> T:
    """An instance of `cls`: what was given, else `base`'s values, else the class's defaults."""
    arguments: dict[str, Any] = {}
    for field, field_type in _fields(cls):
        name, default = prefix + field.name, _default(field, base)
        if dataclasses.is_dataclass(field_type):
            nested = None if default is MISSING else default
            arguments[field.name] = _build(typing.cast(type, field_type), given, nested, f"{name}.")
        elif field_type == Open:
            before = {} if default is MISSING else default
            arguments[field.name] = before | _inside(name, given)
        elif name in given:
            if field.metadata.get("command_line_only") and not given[name].is_word:
                raise UsageError(f"{given[name].where}: this can only be set on the command line; give --{name}=...")
            arguments[field.name] = _decode_given(field_type, given[name])
        elif default is MISSING:
            label = name.upper() if field.metadata.get("positional") else f"--{name}"
            raise UsageError(f"{label} is missing; expected {expected(field_type)}")
        else:
            arguments[field.name] = default
    return cls(**arguments)


def _inside(group: str, given: Mapping[str, _Given]) -> Open:
    return {name.removeprefix(f"{group}."): one.value for name, one in given.items() if name.startswith(f"{group}.")}


def _decode_given(field_type: Any, given: _Given) -> Any:
    try:
        return decode(field_type, given.value, is_word=given.is_word)
    except (ValueError, OverflowError):
        hint = nearest(given.value, choices(field_type)) if isinstance(given.value, str) else ""
        quotes = "; YAML needs quotes around text like this" if field_type is str and not given.is_word else ""
        text = f"{given.where}: expected {expected(field_type)}, got {shorten(given.value)}{hint}{quotes}"
        raise UsageError(text) from None


def _fields(cls: type) -> Iterator[tuple[dataclasses.Field[Any], Any]]:
    hints = typing.get_type_hints(cls)
    return ((field, hints[field.name]) for field in dataclasses.fields(cls) if field.init)


def _default(field: dataclasses.Field[Any], base: Any) -> Any:
    if base is not None:
        return getattr(base, field.name)
    return field.default_factory() if field.default_factory is not MISSING else field.default
