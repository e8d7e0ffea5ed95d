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
    declared,
    decode,
    default_of,
    expected,
    from_word,
    options_of,
    to_plain,
    without_none,
)
from manip_il.errors import ManipError, UsageError, did_you_mean, nearest, nearest_names
from manip_il.evaluation.policy_folder import hub_hint
from manip_il.option import check_bound

CONFIG_PATH = "config_path"  # LeRobot's name for the option that reads YAML
CONFIG_HEADER = "# manip-il"  # how every file from `dump_yaml` begins
# What has taken an option's place; files may still hold it empty.
MOVED = {
    "task.reward": "--task.type=carry:REWARD",
    "within": "read off the page's curves",
    "expert": "measured by manip-il eval --policy.type=expert",
}
_FEW = 3
type Known = Mapping[str, Option]


class _Said(NamedTuple):
    """A value as the user gave it, and its origin, for the error message: `--NAME`, or which file's key."""

    value: Any
    origin: str


def parse[T](cls: type[T], words: Sequence[str], command: str = "COMMAND") -> T:
    """Read options from the command line; `UsageError` for an unknown name, a bad or a missing value.

    command: whose options they are, for the message.
    """
    known = _known(cls)
    said, paths = _read_words(words, known, command)
    trees = [(str(path), read_yaml(path, "a YAML file of options")) for path in map(Path, paths)]
    return from_layers(cls, trees, said)


def from_yaml[T](path: Path, cls: type[T]) -> T:
    """Read options from a YAML file of differences, or from one that `dump_yaml` wrote."""
    return from_layers(cls, [(str(path), read_yaml(path, "a YAML file of options"))])


def from_layers[T](cls: type[T], layers: Sequence[tuple[str, Any]], words: Mapping[str, _Said] | None = None) -> T:
    """Read options from trees of differences, as YAML gives them; a later tree wins, and words of the command line.

    layers: the origin of a tree, for error messages, and the tree. `UsageError` as from a YAML file.
    """
    known, said = _known(cls), dict[str, _Said]()
    for origin, tree in layers:
        said |= _read_tree(tree, known, origin)
    said |= words or {}
    values: dict[tuple[str, ...], Any] = {}
    for option in known.values():
        if option.is_open:
            inside = {name: one for name, one in said.items() if name.startswith(f"{option.name}.")}
            for name, one in inside.items():
                held = values.setdefault(option.path, dict(option.default))
                held[name.removeprefix(f"{option.name}.")] = _decode_said(option, one)
        elif option.name in said:
            one = said[option.name]
            if one.value is not None or without_none(option.type) is not option.type:  # else it was not given
                values[option.path] = _decode_said(option, one)
        elif option.default is MISSING:
            raise UsageError(f"{option.label} is missing; expected {expected(option.type)}")
    return _build(cls, values)


def check_paths(options: Any) -> None:
    """Raise `UsageError` for a path that is to be read, if nothing is there."""
    for one in options_of(type(options)):
        value = one.value(options) if "exists" in one.metadata else None
        for path in value if isinstance(value, list) else [value]:
            if path is not None and not path.exists():
                raise UsageError(
                    f"{path} does not exist; expected {one.metadata['help']}{hub_hint(path, one.metadata['exists'])}"
                )


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
                wanted = f"options are written --name=value, manip-il {command} --help=all lists all"
                raise UsageError(f"unexpected {shorten(word)}; {wanted}")
            option = places[0] if places[0].is_list else places.pop(0)
            before = said[option.name].value if option.is_list and option.name in said else []
            said[option.name] = _Said([*before, word] if option.is_list else word, option.label)
            continue
        name, equals, value = word[2:].partition("=")
        if (ours := name.replace("-", "_")) in known:  # as other programs write it
            name = ours
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
    if _is_inside(name, known):
        return Any
    if name not in known or known[name].positional or known[name].is_open:
        raise _unknown_option("option", name, known, "--", command)
    return known[name].type


def _is_inside(name: str, known: Known) -> bool:
    """Whether `name` is an option of an open group."""
    return name not in known and any(one.is_open and name.startswith(f"{one.name}.") for one in known.values())


def _read_tree(tree: Any, known: Known, origin: str, prefix: str = "") -> dict[str, _Said]:
    """Return what a tree of options says of each."""
    if not isinstance(tree, dict | None):
        where = f"{origin}: {prefix[:-1]}" if prefix else origin
        raise UsageError(f"{where}: expected a mapping of options, got {shorten(tree)}")
    said: dict[str, _Said] = {}
    for key, value in typing.cast(dict[Any, Any], tree or {}).items():
        name = f"{prefix}{key}"
        if (name in known and not known[name].is_open) or _is_inside(name, known):
            said[name] = _Said(value, f"{origin}: {name}")
            if value is not None and name in known and known[name].metadata.get("command_line_only"):
                raise UsageError(f"{origin}: {name}: this can only be set on the command line; give --{name}=...")
        elif any(option == name or option.startswith(f"{name}.") for option in known):
            said |= _read_tree(value, known, origin, f"{name}.")
        elif name not in MOVED or value:
            raise _unknown_option(f"key in {origin}:", name, known, "", "COMMAND")
    return said


def _build(cls: Any, values: Mapping[tuple[str, ...], Any], base: Any = None, path: tuple[str, ...] = ()) -> Any:
    """Return an instance of `cls` of the values by their paths, else of `base`'s, else of the defaults."""
    arguments: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        here, (_, kind), default = (*path, field.name), declared(cls, field), default_of(field, base)
        if "given" in field.metadata:
            said = {inner[-1]: value for inner, value in values.items() if inner[:-1] == here}
            arguments[field.name] = default | said
        elif dataclasses.is_dataclass(kind):
            arguments[field.name] = _build(kind, values, None if default is MISSING else default, here)
        else:
            arguments[field.name] = values.get(here, {} if default is MISSING else default)
    return cls(**arguments)


def _decode_said(option: Option, said: _Said) -> Any:
    kind, is_word = Any if option.is_open else option.type, said.origin.startswith("--")
    if option.is_open and not is_word:
        return said.value
    try:
        value = decode(kind, said.value)
    except ManipError:  # of a class that parses itself
        raise
    except Exception:  # draccus raises bare ones, too
        hint = nearest(said.value, choices(kind)) if isinstance(said.value, str) else ""
        quotes = "; YAML needs quotes around text like this" if kind is str and not is_word else ""
        text = f"{said.origin}: expected {expected(kind)}, got {shorten(said.value)}{hint}{quotes}"
        raise UsageError(text) from None
    check_bound(said.origin, value, option.metadata)
    return value


def _unknown_option(kind: str, name: str, known: Known, dashes: str, command: str) -> UsageError:
    """Return the error for an option or a key that is not there: the nearest names, and the command that lists all.

    `num_episodes` finds `dataset.num_episodes`. kind: `option`, or which file's key. dashes: before the names.
    """
    if name in MOVED:
        return UsageError(f"{dashes}{name} is now {MOVED[name]}")
    if inside := [one.label for one in known.values() if one.label.startswith(f"--{name}.")]:
        return UsageError(f"{dashes}{name} is a group of options; known: {', '.join(inside)}")
    named = [one.name for one in known.values() if not one.is_open and not (dashes and one.positional)]
    leaf, leaves = name.rpartition(".")[2], {one.rpartition(".")[2] for one in named}
    like = [leaf] if leaf in leaves else nearest_names(leaf, sorted(leaves))
    near = [*(one for last in like for one in named if one.rpartition(".")[2] == last), *nearest_names(name, named)]
    offered = did_you_mean([dashes + one for one in list(dict.fromkeys(near))[:_FEW]])
    return UsageError(f"unknown {kind} {shorten(dashes + name)}{offered}; manip-il {command} --help=all lists all")
