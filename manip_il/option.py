"""Options for users: dataclass fields with a line of help, which the command line shows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

from manip_il.errors import UsageError

NameOrPath = str | Path  # of a robot, a task or an object: only a `Path` is ever opened, see `typed`
_FILES = (".py", ".yaml", ".yml", ".json")  # suffixes of files with a user's own task, robot or reward


def typed(text: NameOrPath) -> NameOrPath:
    """Return a robot, a task or an object that a person typed: a `Path` if it names a file, else the name itself.

    Only a `Path` is ever opened. What a dataset, a checkpoint or a result names is a `str`, which is looked up among
    the known names alone, so it must never be passed to this function.
    """
    said = str(text)
    return Path(said) if said.startswith("mesh:") or said.endswith(_FILES) else text


def option(default: Any, help_text: str, **metadata: Any) -> Any:
    """Return a dataclass field. default: a value, a class or function that makes one, or `MISSING` for none.

    metadata: `at_least` and `at_most` (see `check_bound`), and the keys of `manip_il.cli.options.Option`.
    """
    metadata = {"help": help_text, **metadata}
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


def option_of(cls: type, name: str) -> Any:
    """Return a field with the default and help of the field `name` of another dataclass."""
    [theirs] = [one for one in fields(cls) if one.name == name]
    own = theirs.default if theirs.default_factory is MISSING else theirs.default_factory
    return option(own, theirs.metadata["help"])


def check_bound(name: str, value: Any, metadata: Mapping[str, Any]) -> None:
    """Raise `UsageError` if a value that is not None is below `at_least` or above `at_most` in a field's metadata."""
    if value is None or not {"at_least", "at_most"} & metadata.keys():
        return
    low, high = metadata.get("at_least", -math.inf), metadata.get("at_most", math.inf)
    if not low <= value <= high:
        wanted = f"at least {low}" if high == math.inf else f"{low} to {high:,}"
        raise UsageError(f"{name} is {value}; expected {wanted}")


def check_bounds(options: Any, prefix: str = "") -> None:
    """Raise `UsageError` if a field of a dataclass instance is outside the bounds in its metadata."""
    for one in fields(options):
        check_bound(prefix + one.name, getattr(options, one.name), one.metadata)


@dataclass(frozen=True, kw_only=True)
class Seeded:
    """Options of everything that draws random numbers."""

    seed: int = option(0, "random seed, 0 to 1000; it shifts every random stream", at_least=0, at_most=1000)
