"""Settings that users may change: a dataclass's field with a line of help, which the command line shows."""

from __future__ import annotations

from dataclasses import MISSING, field, fields
from typing import Any


def option(default: Any, help_text: str, **metadata: Any) -> Any:
    """Return a dataclass's field. default: a value, a class or function that makes one, or `MISSING` for none.

    metadata: what else the command line is to know, see `manip_il.cli.options.options_of`.
    """
    metadata = {"help": help_text, **metadata}
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


def option_of(cls: type, name: str, default: Any = MISSING, help_text: str = "") -> Any:
    """Return a field with the default and help of the field `name` of another dataclass, unless they are given."""
    [theirs] = [one for one in fields(cls) if one.name == name]
    own = theirs.default if theirs.default_factory is MISSING else theirs.default_factory
    return option(own if default is MISSING else default, help_text or theirs.metadata["help"])
