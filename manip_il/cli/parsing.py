"""Options from the command line (`--a.b=c`) and YAML, in LeRobot's style.

The command line overrides YAML.

Draccus decodes the values (see `decode`). Its parser is not used because it exits through argparse,
turns a range error of a nested dataclass into a decoding error, and has no open groups.

Options of commands: the fields of their dataclasses, the values that a type accepts, and their
names in help.

A field's type is int, float, bool, str, Path, `NameOrPath` or a `Literal` of names; one of these or
None; a list of one of these; a class with `parse` and `__str__` (`linear:5`); another dataclass (a
group, `--dataset.root`); or `Open`: a dict of a group whose options only another program knows
(`--policy.*`). `given(Config)` is a dict of the options of `Config` that the user gave; the command
makes a `Config` from them.
"""

import dataclasses
import functools
import json
import operator
import re
import shlex
import sys
import types
import typing
from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, Union

from manip_il import __version__
from manip_il.checks import parse_yaml, read_yaml, shorten
from manip_il.data.atomic import CONFIG_HEADER
from manip_il.errors import ManipError, UsageError, nearest
from manip_il.option import NameOrPath, check_bound, type_of, typed

Open = dict[str, Any]  # option -> value as read by YAML
Given = dict[str, Any]  # field -> value
_METAVARS: dict[Any, str] = {
    int: "INT",
    float: "FLOAT",
    bool: "true|false",
    str: "TEXT",
    Path: "PATH",
    NameOrPath: "TEXT",
}


def given(
    cls: type,
    prefix: str | None = None,
    only: Collection[str] = (),
    fixed: Collection[str] = (),
    **own: Any,
) -> Any:
    """Return a field that holds those options of a dataclass that the user gave.

    The field is a dict, `Given`.

    Args:
        cls: The dataclass with the options.
        prefix: What the options' names begin with, by default the field's name and a dot.
        only: Names of the options that the command has, by default all.
        fixed: Names of the options that may not grow when the command is resumed.
        own: Defaults that replace those of `cls`; the dict always holds them.
    """
    metadata = {"given": cls, "only": only, "fixed": fixed}
    names = {} if prefix is None else {"prefix": prefix}
    return field(default_factory=functools.partial(dict, own), metadata=metadata | names)


@dataclass(frozen=True)
class Option:
    """One option of a command.

    Attributes:
        name: The dotted name, such as `dataset.root`.
        path: Attributes and keys that lead from the command's options to its value.
        type: The type of its value.
        default: Its default; `MISSING` if the user must give a value.
        metadata: `help`, one line; `positional` for a value without a name; `command_line_only` for
            an option that no file may set; `flag`, the full name; `alias`, another one;
            `at_least` and `at_most`; `free` and `grows` for an option that a resumed run may change
            (see `check_same_options`).
    """

    name: str  # dotted: `dataset.root`
    path: tuple[str, ...]
    type: Any
    default: Any
    metadata: Mapping[str, Any]

    @property
    def positional(self) -> bool:
        """Whether the value is given without the option's name."""
        return self.metadata.get("positional", False)

    @property
    def label(self) -> str:
        """The name as the user writes it."""
        if self.positional:
            return f"{self.name.upper()}..." if self.is_list else self.name.upper()
        return f"--{self.name}.NAME" if self.is_open else f"--{self.name}"

    @property
    def is_list(self) -> bool:
        """Whether the option takes several values."""
        return typing.get_origin(self.type) is list

    @property
    def is_open(self) -> bool:
        """Whether the option is a group of options whose names only another program knows."""
        return typing.get_origin(self.type) in (dict, Mapping)

    def value(self, options: Any) -> Any:
        """Return the option's value in a command's options."""
        for key in self.path:
            options = (
                options.get(key, self.default)
                if isinstance(options, dict)
                else getattr(options, key)
            )
        return options


def options_of(
    cls: type, base: Any = None, prefix: str = "", path: tuple[str, ...] = ()
) -> list[Option]:
    """Return all options of a dataclass, with its groups expanded and keyword-only options last.

    Args:
        cls: The dataclass.
        base: An instance whose values are the defaults; None for those of the class.
        prefix: What the options' names begin with.
        path: Attributes that lead from the command's options to this dataclass.
    """
    found: list[Option] = []
    for one in sorted(dataclasses.fields(cls), key=lambda one: one.kw_only is True):
        inner, here = one.metadata.get("prefix", f"{prefix}{one.name}."), (*path, one.name)
        kind, default = type_of(cls, one), default_of(one, base)
        if source := one.metadata.get("given"):
            for theirs in dataclasses.fields(source):
                if "help" in theirs.metadata and theirs.name in (
                    one.metadata["only"] or (theirs.name,)
                ):
                    name = theirs.metadata.get("flag", inner + theirs.name)
                    own, about = default.get(theirs.name, default_of(theirs)), dict(theirs.metadata)
                    if theirs.name in one.metadata["fixed"]:
                        about["grows"] = False
                    kind = type_of(source, theirs)
                    found.append(Option(name, (*here, theirs.name), kind, own, about))
        elif dataclasses.is_dataclass(kind):
            found += options_of(
                typing.cast(type, kind), None if default is MISSING else default, inner, here
            )
        else:
            found.append(
                Option(
                    one.metadata.get("flag", prefix + one.name), here, kind, default, one.metadata
                )
            )
    return found


def default_of(one: dataclasses.Field[Any], base: Any = None) -> Any:
    """Return a field's value in `base`, else its default, else `MISSING`."""
    if base is not None:
        return getattr(base, one.name)
    return one.default if one.default_factory is MISSING else one.default_factory()


def to_plain(options: Any) -> dict[str, Any]:
    """Return a command's options as a tree of plain YAML values, keyed by option names.

    Omits what concerns one call alone, so that a file made from it never replaces or continues
    another output.
    """
    tree: dict[str, Any] = {}
    for one in options_of(type(options)):
        if not one.metadata.get("command_line_only") and one.name not in ("overwrite", "resume"):
            _put(tree, one.name.split("."), _plain(one.value(options)))
    return tree


def _put(tree: dict[str, Any], path: Sequence[str], value: Any) -> None:
    """Set a value in a tree, creating the groups on its path."""
    *groups, last = path
    functools.reduce(lambda inner, name: inner.setdefault(name, {}), groups, tree)[last] = value


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) or hasattr(value, "parse") else value


def command_line() -> str:
    """Return the command as typed, quoted for a shell."""
    return shlex.join(["manip-il", *sys.argv[1:]])


def word(value: Any) -> str:
    """Return a value as written on the command line."""
    plain = _plain(value)
    if isinstance(plain, list):
        return ",".join(map(str, plain))
    return json.dumps(plain) if plain is None or isinstance(plain, bool) else str(plain)


def metavar(option_type: Any) -> str:
    """Return the placeholder of a value in help and errors: `INT`, `PATH`, `mse|l1`,
    `FLOAT,...`.
    """
    option_type = without_none(option_type)
    if typing.get_origin(option_type) is list:
        return f"{metavar(typing.get_args(option_type)[0])},..."
    if typing.get_origin(option_type) is Literal:
        return "|".join(typing.get_args(option_type))
    return _METAVARS.get(option_type, "VALUE")


def decode(option_type: Any, value: Any) -> Any:
    """Convert `value`, from YAML or text, to the declared type.

    Raises one of several errors if it is invalid.

    Unlike draccus, takes `a,b` for a list and `none` for None, and refuses a boolean as a number or
    text, NaN as a number, and "" as a path (the current folder).
    """
    import draccus  # imported here because help does not need it

    some = without_none(option_type)
    if some != option_type and value in ("null", "none"):
        return None
    if option_type is Any:
        return parse_yaml(value)
    if hasattr(some, "parse") and isinstance(value, str):
        return some.parse(value)
    if typing.get_origin(some) is list and isinstance(value, str):
        inner = value.removeprefix("[").removesuffix("]")
        value = [item.strip(" '\"") for item in inner.split(",")] if inner else []
    if some == NameOrPath:
        return typed(_expand(draccus.decode(str, value)))
    decoded: Any = draccus.decode(option_type, value)
    if (
        decoded != decoded
        or (isinstance(value, bool) and some is not bool)
        or (some is Path and value == "")
    ):
        raise ValueError
    return [_expand(item) for item in decoded] if isinstance(decoded, list) else _expand(decoded)


def _expand(value: Any) -> Any:
    """Expand the tilde in a path, such as `~/x`, `carry:~/x` and `mesh:~/x`: shells do so only
    in a word of its own.
    """
    if isinstance(value, str):
        return re.sub(r"^(\w+:)?~/", lambda found: f"{found[1] or ''}{Path.home()}/", value)
    return value.expanduser() if isinstance(value, Path) else value


def without_none(option_type: Any) -> Any:
    """Return `X` of `X | None`, and any other type as it is."""
    if typing.get_origin(option_type) not in (Union, types.UnionType):
        return option_type
    return functools.reduce(
        operator.or_, (one for one in typing.get_args(option_type) if one is not types.NoneType)
    )


CONFIG_PATH = "config_path"  # LeRobot's name for the option that reads YAML
_EXPECTED = "a YAML file of options"
type Known = Mapping[str, Option]


class _Value(NamedTuple):
    """A value as the user gave it. origin: `--NAME`, or the file and key, for error messages."""

    option: Option
    value: Any
    origin: str


def parse[T](cls: type[T], words: Sequence[str]) -> T:
    """Read options from the command line.

    Args:
        cls: The dataclass of the command's options.
        words: The words after the command's name.

    Raises:
        UsageError: for an unknown name, or for an invalid or missing value.
    """
    known = _named(options_of(cls))
    known[CONFIG_PATH] = Option(CONFIG_PATH, (), Path, None, {})
    raw = _read_words(words, known)
    file = raw.pop(CONFIG_PATH, None)
    layers = [] if file is None else [(file.value, read_yaml(Path(file.value), _EXPECTED))]
    return from_layers(cls, layers, raw)


def from_yaml[T](path: Path, cls: type[T]) -> T:
    """Read options from a YAML file, with defaults for the others."""
    return from_layers(cls, [(str(path), read_yaml(path, _EXPECTED))])


def from_layers[T](
    cls: type[T], layers: Sequence[tuple[str, Any]], words: Mapping[str, _Value] | None = None
) -> T:
    """Read options from trees of YAML and from words.

    Args:
        cls: The dataclass of the options.
        layers: Pairs (origin, tree), of which later ones override earlier ones; error messages name
            the origin.
        words: Name -> value from the command line; they override all trees.

    Raises:
        UsageError: for an unknown name, or for an invalid or missing value.
    """
    known = _named(options_of(cls))
    raw = dict[str, _Value]()
    for origin, tree in layers:
        raw |= _read_tree(tree, known, origin)
    changes = dict[str, Any]()
    for name, one in (raw | dict(words or {})).items():
        option = one.option
        # other nulls mean the default
        if option.is_open or one.value is not None or without_none(option.type) != option.type:
            own = (name.removeprefix(f"{option.name}."),) if option.is_open else ()
            _put(changes, option.path + own, _decode(one))
            known.pop(name, None)
    for option in known.values():
        if option.default is MISSING:
            raise UsageError(f"{option.label} is missing; expected {metavar(option.type)}")
    return _build(cls, changes)


def _named(options: Sequence[Option]) -> dict[str, Option]:
    """Return options by their names, and by their aliases."""
    aliases = {one.metadata["alias"]: one for one in options if "alias" in one.metadata}
    return aliases | {one.name: one for one in options}


def dump_yaml(options: Any) -> str:
    """Return the resolved options as YAML, which `from_yaml` reads back."""
    import yaml

    header = f"{CONFIG_HEADER} {__version__}: resolved options ({type(options).__name__})\n"
    return header + yaml.safe_dump(to_plain(options), sort_keys=False)


def _read_words(words: Sequence[str], known: Known) -> dict[str, _Value]:
    """Return each option's value as given on the command line."""
    raw: dict[str, _Value] = {}
    places = [option for option in known.values() if option.positional]
    rest = [*words]
    while rest:
        word = rest.pop(0)
        name, equals, value = word[2:].partition("=")
        # the rest is another program's command line
        if word == "--" and places and places[-1].is_list:
            raw[places[-1].name] = _Value(places[-1], rest, places[-1].label)
            break
        if word.startswith("--"):
            option = _find(name, known)
            if option is None or option.positional:
                raise _unknown_option("option", f"--{name}", known)
            kind = Any if option.is_open else option.type
            if not equals and kind is bool:
                value = rest.pop(0) if rest and rest[0] in ("true", "false") else "true"
            elif not equals and rest and not rest[0].startswith("--"):
                value = rest.pop(0)
            elif not equals:
                raise UsageError(
                    f"--{name} has no value; write --{name}=VALUE, expected {metavar(kind)}"
                )
            raw[name] = _Value(option, value, f"--{name}")
        elif not places or word.startswith("-"):
            wanted = "write options as --name=value; --help lists them"
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
    return next(
        (one for one in known.values() if one.is_open and name.startswith(f"{one.name}.")), None
    )


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
                raise UsageError(
                    f"{origin}: {name} can only be set on the command line; give --{name}=..."
                )
        elif any(other == name or other.startswith(f"{name}.") for other in known):
            raw |= _read_tree(value, known, origin, f"{name}.")
        else:
            raise _unknown_option(f"key in {origin}:", name, known)
    return raw


def _build(cls: Any, changes: Mapping[str, Any], base: Any = None) -> Any:
    """Return an instance of `cls`, of which `changes` holds the fields that differ from `base`."""
    values = dict[str, Any]()
    for one in dataclasses.fields(cls):
        kind, default = type_of(cls, one), default_of(one, base)
        if "given" in one.metadata:
            values[one.name] = default | changes.get(one.name, {})
        elif dataclasses.is_dataclass(kind):
            base_of_group = None if default is MISSING else default
            values[one.name] = _build(kind, changes.get(one.name, {}), base_of_group)
        else:
            values[one.name] = changes.get(one.name, default)
    return cls(**values)


def _decode(one: _Value) -> Any:
    kind = Any if one.option.is_open else one.option.type
    if one.option.is_open and (not one.origin.startswith("--") or one.origin.endswith(".path")):
        return one.value  # of YAML, or a path: 2024_01_05 is a folder, not a number
    try:
        value = decode(kind, one.value)
    except ManipError:  # from a class with its own `parse`
        raise
    except Exception:  # draccus also raises plain Exception
        raise UsageError(
            f"{one.origin}: expected {metavar(kind)}, got {shorten(one.value)}"
        ) from None
    check_bound(one.origin, value, one.option.metadata)
    return value


def _unknown_option(kind: str, name: str, known: Known) -> UsageError:
    """Return the error for an unknown option or key, with the nearest name.

    `num_episodes` finds `dataset.num_episodes`. kind: `option`, or `key in FILE:`.
    """
    labels = [
        one.label if key == one.name else f"--{key}"
        for key, one in known.items()
        if not one.positional
    ]
    if not name.startswith("--"):
        labels = [label.replace("--", "") for label in labels]
    return UsageError(f"unknown {kind} {shorten(name)}{nearest(name, labels)}; --help lists all")
