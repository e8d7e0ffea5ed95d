"""Options from the command line (`--a.b=c`) and from YAML, in LeRobot's style; words beat YAML beats defaults.

Draccus reads the values (see `options.decode`). What is around them is our own, as its parser exits through argparse,
turns a range error of a nested dataclass into a decoding error, and knows no open groups.
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
    choices,
    decode,
    expected,
    fields_of,
    from_word,
    options_of,
    to_plain,
    without_none,
)
from manip_il.errors import ManipError, UsageError, did_you_mean, nearest, nearest_names
from manip_il.option import check_bound

CONFIG_PATH = "config_path"  # LeRobot's name for the option that reads YAML
CONFIG_HEADER = "# manip-il"  # how every file from `dump_yaml` begins
MOVED = {"task.reward": "--task.type=carry:"}  # where an option's value stands now; files may still hold it empty
_FEW = 3
type Known = Mapping[str, Option]


class _Said(NamedTuple):
    """A value as the user gave it, and its origin, for the error message: `--NAME`, or which file's key."""

    value: Any
    origin: str

    @property
    def is_word(self) -> bool:
        """Whether it is from the command line."""
        return self.origin.startswith("--")


def parse[T](cls: type[T], words: Sequence[str], command: str = "") -> T:
    """Read options from the command line; `UsageError` for an unknown name, a bad or a missing value.

    command: whose options they are, for the message.
    """
    from_words, paths = _read_words(words, _known(cls), command)
    return _make(cls, [(path, read_yaml(Path(path), "a YAML file of options")) for path in paths], from_words)


def from_yaml[T](path: Path, cls: type[T]) -> T:
    """Read options from a YAML file of differences, or from one that `dump_yaml` wrote."""
    return _make(cls, [(str(path), read_yaml(path, "a YAML file of options"))])


def from_layers[T](cls: type[T], layers: Sequence[tuple[str, Any]]) -> T:
    """Read options from trees of differences, as YAML gives them; a later tree wins.

    layers: the origin of a tree, for error messages, and the tree. `UsageError` as from a YAML file.
    """
    return _make(cls, layers)


def check_values(options: Any, prefix: str | None = None) -> None:
    """Refuse values out of bounds, and what the options' own `check` refuses: paths that are not there, most of all.

    prefix: of the names in messages, in place of two dashes.
    """
    for one in options_of(type(options)):
        value = one.value(options)
        check_bound(one.label if prefix is None else prefix + one.name, value, one.metadata)
        for item in value if one.is_list else [value]:
            if item is not None and "check" in one.metadata:
                one.metadata["check"](item)


def dump_yaml(options: Any) -> str:
    """Return the resolved options as YAML: `from_yaml` gives them back equal."""
    import yaml

    header = f"{CONFIG_HEADER} {__version__}: resolved options ({type(options).__name__})\n"
    return header + yaml.safe_dump(to_plain(options), sort_keys=False)


def _known(cls: type) -> Known:
    return {option.name: option for option in options_of(cls)}


def _read_words(words: Sequence[str], known: Known, command: str) -> tuple[dict[str, _Said], list[str]]:
    """Return what was said of each option, and the YAML files that are to be read."""
    said: dict[str, _Said] = {}
    config_paths: list[str] = []
    places = [option for option in known.values() if option.positional]
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word == "--" and places and places[-1].is_list:  # what follows belongs to another program
            said[places[-1].name] = _Said(rest, places[-1].label)
            break
        if not word.startswith("--"):
            if not places or word.startswith("-"):
                raise UsageError(f"unexpected {shorten(word)}; options are written --name=value, {_lists(command)}")
            option = places[0] if places[0].is_list else places.pop(0)
            before = said[option.name].value if option.is_list and option.name in said else []
            said[option.name] = _Said([*before, word] if option.is_list else word, option.label)
            continue
        name, equals, value = word[2:].partition("=")
        if (ours := name.replace("-", "_")) in known:  # as other programs write it
            name = ours
        if name in MOVED:
            raise UsageError(f"--{name} has a new name: {MOVED[name]}{value or 'REWARD'}")
        kind = Path if name == CONFIG_PATH else _type_of(name, known, command)
        if not equals and kind is bool and (not rest or rest[0] not in ("true", "false")):
            value = "true"
        elif not equals:
            if not rest or rest[0].startswith("--"):
                raise UsageError(f"--{name} has no value; expected {expected(kind)}")
            value = rest.pop(0)
        if name == CONFIG_PATH:
            config_paths.append(value)
        else:
            said[name] = _Said(from_word(kind, value), f"--{name}")
    return said, config_paths


def _type_of(name: str, known: Known, command: str) -> Any:
    """Return the type of an option that is given by its name, `Any` of one in an open group."""
    if _open_group(name, known):
        return Any
    if name not in known or known[name].positional or known[name].is_open:
        raise _unknown_option("option", name, known, "--", command)
    return known[name].type


def _open_group(name: str, known: Known) -> str:
    """Return the open group that `name` is an option of, or nothing."""
    if name in known:
        return ""
    return next((option.name for option in known.values() if option.is_open and name.startswith(f"{option.name}.")), "")


def _read_tree(tree: Any, known: Known, origin: str, prefix: str = "") -> dict[str, _Said]:
    """Return what a tree of options says of each."""
    if not isinstance(tree, dict | None):
        where = f"{origin}: {prefix[:-1]}" if prefix else origin
        raise UsageError(f"{where}: expected a mapping of options, got {shorten(tree)}")
    said: dict[str, _Said] = {}
    for key, value in typing.cast(dict[Any, Any], tree or {}).items():
        name = f"{prefix}{key}"
        if name in MOVED:
            if value:
                raise UsageError(f"{origin}: {name} has a new name: {MOVED[name]}{value}")
        elif (name in known and not known[name].is_open) or _open_group(name, known):
            said[name] = _Said(value, f"{origin}: {name}")
        elif name in known or any(option.startswith(f"{name}.") for option in known):
            said |= _read_tree(value, known, origin, f"{name}.")
        else:
            raise _unknown_option(f"key in {origin}:", name, known, "", "")
    return said


def _make[T](cls: type[T], layers: Sequence[tuple[str, Any]], words: Mapping[str, _Said] | None = None) -> T:
    known, said = _known(cls), dict[str, _Said]()
    for origin, tree in layers:
        said |= _read_tree(tree, known, origin)
    said |= words or {}
    values: dict[tuple[str, ...], Any] = {}
    for option in known.values():
        if option.is_open:
            inside = {
                name.removeprefix(f"{option.name}."): _decode_said(Any, one)
                for name, one in said.items()
                if name.startswith(f"{option.name}.")
            }
            if inside:
                values[option.path] = ({} if option.default is MISSING else option.default) | inside
        elif option.name in said:
            one = said[option.name]
            if option.metadata.get("command_line_only") and not one.is_word:
                raise UsageError(f"{one.origin}: this can only be set on the command line; give --{option.name}=...")
            if one.value is not None or not option.is_given or without_none(option.type) is not option.type:
                values[option.path] = _decode_said(option.type, one)  # else null says that it was not given
        elif option.default is MISSING:
            raise UsageError(f"{option.label} is missing; expected {expected(option.type)}")
    return _build(cls, values)


def _build[T](cls: type[T], values: Mapping[tuple[str, ...], Any], base: Any = None, path: tuple[str, ...] = ()) -> T:
    """Return an instance of `cls` of the values by their paths, else of `base`'s, else of the defaults."""
    arguments: dict[str, Any] = {}
    for field, kind, default in fields_of(cls, base):
        here = (*path, field.name)
        if "given" in field.metadata:
            arguments[field.name] = {inner[-1]: value for inner, value in values.items() if inner[:-1] == here}
        elif dataclasses.is_dataclass(kind):
            inner_base = None if default is MISSING else default
            arguments[field.name] = _build(typing.cast(type, kind), values, inner_base, here)
        else:
            arguments[field.name] = values.get(here, {} if default is MISSING else default)
    return cls(**arguments)


def _decode_said(option_type: Any, said: _Said) -> Any:
    if option_type is Any and not said.is_word:
        return said.value
    try:
        return decode(option_type, said.value)
    except ManipError:  # of a class that parses itself
        raise
    except Exception:  # draccus raises bare ones, too
        hint = nearest(said.value, choices(option_type)) if isinstance(said.value, str) else ""
        quotes = "; YAML needs quotes around text like this" if option_type is str and not said.is_word else ""
        text = f"{said.origin}: expected {expected(option_type)}, got {shorten(said.value)}{hint}{quotes}"
        raise UsageError(text) from None


def _unknown_option(kind: str, name: str, known: Known, dashes: str, command: str) -> UsageError:
    """Return the error for an option or a key that is not there: the nearest names, and the command that lists all.

    `num_episodes` finds `dataset.num_episodes`. kind: `option`, or which file's key. dashes: before the names.
    command: empty if none is known.
    """
    inside = [one.label for one in known.values() if one.label.startswith(f"--{name}.")]
    if inside:
        return UsageError(f"{dashes}{name} is a group of options; known: {', '.join(inside)}")
    by_leaf: dict[str, list[str]] = {}
    for one in known.values():
        if not one.is_open and not (dashes and one.positional):
            by_leaf.setdefault(one.name.rpartition(".")[2], []).append(one.name)
    leaf, named = name.rpartition(".")[2], [one for names in by_leaf.values() for one in names]
    leaves = [leaf] if leaf in by_leaf else nearest_names(leaf, by_leaf)
    near = [*(one for found in leaves for one in by_leaf[found]), *nearest_names(name, named)]
    offered = did_you_mean([dashes + one for one in list(dict.fromkeys(near))[:_FEW]])
    return UsageError(f"unknown {kind} {shorten(dashes + name)}{offered}; {_lists(command)}")


def _lists(command: str) -> str:
    return f"manip-il {command or 'COMMAND'} --help=all lists all"
