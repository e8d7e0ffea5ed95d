"""Options from the command line (`--a.b=c`) and YAML, in LeRobot's style; the command line overrides YAML.

Draccus decodes the values (see `options.decode`). Its parser is not used because it exits through argparse, turns a
range error of a nested dataclass into a decoding error, and has no open groups.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping, Sequence
from dataclasses import MISSING
from pathlib import Path
from typing import Any, NamedTuple

from manip_il import __version__
from manip_il.checks import read_yaml, shorten
from manip_il.cli.options import (
    Option,
    decode,
    default_of,
    from_word,
    metavar,
    options_of,
    to_plain,
    without_none,
)
from manip_il.data.ownership import CONFIG_HEADER
from manip_il.errors import ManipError, UsageError, nearest
from manip_il.learn.policy_folder import hub_hint
from manip_il.option import check_bound, type_of

CONFIG_PATH = "config_path"  # LeRobot's name for the option that reads YAML
_EXPECTED = "a YAML file of options"
_MOST_OFFERED = 3  # names that an error suggests
type Known = Mapping[str, Option]


class _Value(NamedTuple):
    """A value as the user gave it. origin: `--NAME`, or the file and key, for error messages."""

    option: Option
    value: Any
    origin: str


def parse[T](cls: type[T], words: Sequence[str], command: str = "COMMAND") -> T:
    """Read options from the command line; `UsageError` for an unknown name, or an invalid or missing value.

    command: the command's name, for error messages.
    """
    known = {option.name: option for option in options_of(cls)}
    known[CONFIG_PATH] = Option(CONFIG_PATH, (), Path, None, {})
    raw = _read_words(words, known, command)
    file = raw.pop(CONFIG_PATH, None)
    layers = [] if file is None else [(file.value, read_yaml(Path(file.value), _EXPECTED))]
    return from_layers(cls, layers, raw)


def from_yaml[T](path: Path, cls: type[T]) -> T:
    """Read options from a YAML file, with defaults for the others."""
    return from_layers(cls, [(str(path), read_yaml(path, _EXPECTED))])


def from_layers[T](cls: type[T], layers: Sequence[tuple[str, Any]], words: Mapping[str, _Value] | None = None) -> T:
    """Read options from trees of YAML; later trees override earlier ones, and `words` override all.

    layers: pairs (origin, tree); error messages name the origin. Raises `UsageError` as `parse` does.
    """
    known = {option.name: option for option in options_of(cls)}
    raw = dict[str, _Value]()
    for origin, tree in layers:
        raw |= _read_tree(tree, known, origin)
    values = {option.path: option.default for option in known.values() if not option.is_given}
    for name, one in (raw | dict(words or {})).items():
        option = one.option
        if option.is_open:
            values[option.path] = values.get(option.path, {}) | {name.removeprefix(f"{option.name}."): _decode(one)}
        elif one.value is not None or without_none(option.type) != option.type:  # other nulls mean the default
            values[option.path] = _decode(one)
    for option in known.values():
        if option.default is MISSING and values.get(option.path, MISSING) is MISSING:
            raise UsageError(f"{option.label} is missing; expected {metavar(option.type)}")
    return _build(cls, values)


def check_paths(options: Any) -> None:
    """Raise `UsageError` if a path to read does not exist."""
    for one in options_of(type(options)):
        value = one.value(options) if "exists" in one.metadata else None
        for path in value if isinstance(value, list) else [value]:
            if path is not None and not path.exists():
                raise UsageError(
                    f"{path} does not exist; expected {one.metadata['help']}{hub_hint(path, one.metadata['exists'])}"
                )


def dump_yaml(options: Any) -> str:
    """Return the resolved options as YAML, which `from_yaml` reads back."""
    import yaml

    header = f"{CONFIG_HEADER} {__version__}: resolved options ({type(options).__name__})\n"
    return header + yaml.safe_dump(to_plain(options), sort_keys=False)


def _read_words(words: Sequence[str], known: Known, command: str) -> dict[str, _Value]:
    """Return each option's value as given on the command line."""
    raw: dict[str, _Value] = {}
    places = [option for option in known.values() if option.positional]
    for number, word in enumerate(words):
        name, equals, value = word[2:].partition("=")
        if word == "--" and places and places[-1].is_list:  # the rest is another program's command line
            raw[places[-1].name] = _Value(places[-1], list(words[number + 1 :]), places[-1].label)
            break
        if word.startswith("--"):
            name = name.replace("-", "_")  # accept --output-dir
            option = _find(name, known)
            if option is None or option.positional:
                raise _unknown_option("option", name, known, "--", command)
            kind = Any if option.is_open else option.type
            if not equals and kind is not bool:
                raise UsageError(f"--{name} has no value; write --{name}=VALUE, expected {metavar(kind)}")
            raw[name] = _Value(option, from_word(kind, value if equals else "true"), f"--{name}")
        elif not places or word.startswith("-"):
            wanted = f"write options as --name=value; manip-il {command} --help=all lists them"
            raise UsageError(f"unexpected {shorten(word)}; {wanted}")
        elif (option := places[0]).is_list:
            raw.setdefault(option.name, _Value(option, [], option.label)).value.append(word)
        else:
            raw[option.name] = _Value(places.pop(0), word, option.label)
    return raw


def _find(name: str, known: Known) -> Option | None:
    """Return the option of a name, or the open group that it is in."""
    if name in known and not known[name].is_open:
        return known[name]
    return next((one for one in known.values() if one.is_open and name.startswith(f"{one.name}.")), None)


def _read_tree(tree: Any, known: Known, origin: str, prefix: str = "") -> dict[str, _Value]:
    """Return each option's value in a tree."""
    if not isinstance(tree, dict | None):
        where = f"{origin}: {prefix[:-1]}" if prefix else origin
        raise UsageError(f"{where}: expected a mapping of options, got {shorten(tree)}")
    raw: dict[str, _Value] = {}
    for key, value in typing.cast(dict[Any, Any], tree or {}).items():
        name = f"{prefix}{key}"
        if option := _find(name, known):
            raw[name] = _Value(option, value, f"{origin}: {name}")
            if value is not None and option.metadata.get("command_line_only"):
                raise UsageError(f"{origin}: {name} can only be set on the command line; give --{name}=...")
        elif any(other == name or other.startswith(f"{name}.") for other in known):
            raw |= _read_tree(value, known, origin, f"{name}.")
        else:
            raise _unknown_option(f"key in {origin}:", name, known, "", "COMMAND")
    return raw


def _build(cls: Any, values: Mapping[tuple[str, ...], Any], path: tuple[str, ...] = ()) -> Any:
    """Return an instance of `cls`. values: of its options, by path."""
    arguments: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        here, kind = (*path, field.name), type_of(cls, field)
        if "given" in field.metadata:
            raw = {inner[-1]: value for inner, value in values.items() if inner[:-1] == here}
            arguments[field.name] = default_of(field) | raw
        else:
            arguments[field.name] = _build(kind, values, here) if dataclasses.is_dataclass(kind) else values[here]
    return cls(**arguments)


def _decode(one: _Value) -> Any:
    kind = Any if one.option.is_open else one.option.type
    if one.option.is_open and (not one.origin.startswith("--") or one.origin.endswith(".path")):
        return one.value  # of YAML, or a path: 2024_01_05 is a folder, not a number
    try:
        value = decode(kind, one.value)
    except ManipError:  # from a class with its own `parse`
        raise
    except Exception:  # draccus also raises plain Exception
        raise UsageError(f"{one.origin}: expected {metavar(kind)}, got {shorten(one.value)}") from None
    check_bound(one.origin, value, one.option.metadata)
    return value


def _unknown_option(kind: str, name: str, known: Known, dashes: str, command: str) -> UsageError:
    """Return the error for an unknown option or key, with the nearest names and the command that lists all.

    `num_episodes` finds `dataset.num_episodes`. kind: `option`, or `key in FILE:`. dashes: prefix of the names.
    """
    named = [one.label.replace("--", dashes) for one in known.values() if not one.positional]
    near = nearest(dashes + name, named, _MOST_OFFERED)
    return UsageError(f"unknown {kind} {shorten(dashes + name)}{near}; manip-il {command} --help=all lists all")
