"""Options for users: dataclass fields with a line of help, which the command line shows."""

import contextlib
import math
import numbers
import sys
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, field, fields
from pathlib import Path
from typing import Any

from manip_il.errors import UnknownName, UsageError, shorten

# of a robot, a task or an object: only a `Path` is ever opened, see `typed`
NameOrPath = str | Path
# suffixes of files with a user's own task, robot or reward
_FILES = (".py", ".yaml", ".yml", ".json")


def typed(text: NameOrPath) -> NameOrPath:
    """Return a robot, a task or an object that a person typed: a `Path` if it names a file, else
    the name itself.

    Only a `Path` is ever opened. What a dataset, a checkpoint or a result names is a `str`, which
    is looked up among the known names alone, so it must never be passed to this function.
    """
    said = str(text)
    return Path(said) if said.startswith("mesh:") or said.endswith(_FILES) else text


def option(default: Any, help_text: str, **metadata: Any) -> Any:
    """Return a dataclass field with a line of help.

    Args:
        default: A value, a class or function that makes one, or `MISSING` for none.
        help_text: The help that the command line shows.
        metadata: `at_least` and `at_most` (see `check_bound`), and the keys of
            `manip_il.cli.parsing.Option`.
    """
    metadata = {"help": help_text, **metadata}
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


def keyword(default: Any, help_text: str, **metadata: Any) -> Any:
    """Return a field like `option`, which stays a keyword if a class without `kw_only` declares
    it again.
    """
    made = option(Path(default) if isinstance(default, str) else default, help_text, **metadata)
    made.kw_only = True
    return made


def bounded(default: Any, low: float, high: float) -> Any:
    """Return a dataclass field that is no option, but has the bounds of one.

    Args:
        default: The default of the field.
        low: The least value that is allowed.
        high: The greatest value that is allowed.
    """
    return field(default=default, metadata={"at_least": low, "at_most": high})


def option_of(cls: type, name: str) -> Any:
    """Return a field with the default and help of the field `name` of another dataclass."""
    [theirs] = [one for one in fields(cls) if one.name == name]
    own = theirs.default if theirs.default_factory is MISSING else theirs.default_factory
    return option(own, theirs.metadata["help"])


def check_bound(name: str, value: Any, metadata: Mapping[str, Any]) -> None:
    """Raise `UsageError` if a value is outside the bounds in a field's metadata.

    Args:
        name: The name of the option, for the message.
        value: The value to check; None is always allowed.
        metadata: The field's metadata. `at_least` and `at_most` are the bounds, if given.

    Raises:
        UsageError: The value is below `at_least` or above `at_most`.
    """
    if value is None or not {"at_least", "at_most"} & metadata.keys():
        return
    low, high = metadata.get("at_least", -math.inf), metadata.get("at_most", math.inf)
    if not low <= value <= high:
        wanted = f"at least {low}" if high == math.inf else f"{low} to {high:,}"
        raise UsageError(f"{name} is {value}; expected {wanted}")


def check_bounds(options: Any, prefix: str = "") -> None:
    """Raise `UsageError` if a field of a dataclass instance has another type, or is outside its
    metadata's bounds.

    Args:
        options: The dataclass instance.
        prefix: What stands before the fields' names in the message, such as `policy.`.

    Raises:
        UsageError: A value has the wrong type or is out of bounds.
    """
    for one in fields(options):
        name, value = prefix + one.name, getattr(options, one.name)
        kind: Any = object
        with contextlib.suppress(NameError):  # a name that only type checkers import
            kind = type_of(type(options), one)
        if not _is_of(value, kind):
            known = kind.__name__ if isinstance(kind, type) else str(kind).replace("typing.", "")
            raise UsageError(f"{name} is {shorten(value)}; expected {known}")
        check_bound(name, value, one.metadata)


def type_of(cls: type, one: Field[Any]) -> Any:
    """Return the type of one field of a dataclass.

    The annotations of its other fields are not evaluated.
    """
    home = next(base for base in cls.__mro__ if one.name in vars(base).get("__annotations__", {}))
    return (
        eval(one.type, vars(sys.modules[home.__module__]))
        if isinstance(one.type, str)
        else one.type
    )


def _is_of(value: Any, kind: Any) -> bool:
    """Whether a value is of a field's type; what is in a list or a mapping is not looked at."""
    origin = typing.get_origin(kind) or kind
    if origin in (typing.Union, types.UnionType):
        return any(_is_of(value, one) for one in typing.get_args(kind))
    if origin is typing.Literal:
        return value in typing.get_args(kind)
    if origin in (int, float):
        numbers_of = numbers.Integral if origin is int else numbers.Real
        return isinstance(value, numbers_of) and not isinstance(value, bool)
    if not isinstance(origin, type) or getattr(origin, "_is_protocol", False):
        return True
    return isinstance(value, (tuple, list) if origin is tuple else origin)  # JSON has lists


def make_options[T](cls: type[T], **options: Any) -> T:
    """Return an instance of a dataclass of options.

    Args:
        cls: The dataclass.
        options: Values of its fields by name.

    Raises:
        UnknownName: The dataclass does not have such an option.
    """
    known = [one.name for one in fields(typing.cast(Any, cls))]
    for name in options:
        if name not in known:
            raise UnknownName("option", name, known)
    return cls(**options)


@dataclass(frozen=True, kw_only=True)
class Seeded:
    """Options of everything that draws random numbers."""

    seed: int = option(
        0, "random seed, 0 to 1000; it shifts every random stream", at_least=0, at_most=1000
    )
