"""`--suite=`: which conditions an evaluation deals its episodes among."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import manip_il
from manip_il.errors import ManipError, UnknownName, UsageError

if TYPE_CHECKING:
    from manip_il.sim.conditions import Condition

SUITES = {
    "nominal": ("nominal",),
    "disturbed": ("knocked", "sensing"),
    "randomised": ("object", "view"),
    "all": ("nominal", "knocked", "sensing", "object", "view"),
}
CONDITIONS = SUITES["all"]
SUITE_HELP = "nominal, disturbed, randomised, all; one condition (knocked, sensing, object, view); or a YAML of ranges"


def suite_conditions(suite: str, task: str, *, sees: bool) -> tuple[Condition, ...]:
    """Return the conditions of a suite, in the order in which seeds take turns.

    Without those that change nothing: for a task without an object, or (`sees` false) for what looks at no camera.
    Raises `UnknownName` for a suite, `UsageError` for a file that is not one or where nothing is left.
    """
    from manip_il.tasks.table import get_task

    has_object = bool(get_task(task).grasped)
    asked = [_read(name) for name in SUITES.get(suite, (suite,))]
    left = [one for condition in asked if (one := condition.for_world(has_object=has_object, sees=sees)) is not None]
    if not left:
        blind = "" if sees else " and a policy without cameras"
        raise UsageError(f"--suite={suite} changes nothing for {task}{blind}; choose another suite")
    return tuple(left)


def require_suite(suite: str) -> None:
    """Raise `UnknownName` for a suite that is not there, `UsageError` for a file that is not; none is read."""
    if _is_file(suite):
        if not Path(suite).is_file():
            raise UsageError(f"--suite={suite}: no such file; expected a YAML of ranges")
    elif suite not in (*SUITES, *CONDITIONS):
        raise UnknownName("suite", suite, [*SUITES, *CONDITIONS[1:]])


def _is_file(suite: str) -> bool:
    return suite.endswith((".yaml", ".yml"))


def _read(name: str) -> Condition:
    require_suite(name)
    return read_condition(Path(name) if _is_file(name) else _folder() / f"{name}.yaml")


def read_condition(path: Path) -> Condition:
    """Return a YAML of ranges as a condition of the file's name; `UsageError` names what is wrong with it."""
    from manip_il.sim.conditions import Condition
    from manip_il.yaml_file import read_yaml

    tree = read_yaml(path, "a YAML of ranges")
    if not isinstance(tree, dict | None):
        raise UsageError(f"{path} holds {type(tree).__name__}; expected a mapping of names to ranges")
    return Condition.from_mapping(path.stem, tree or {})


def _folder() -> Path:
    """Of the suites' files: in a checkout beside the package, else where an installation puts data."""
    places = (Path(manip_il.__file__).parents[1] / "configs", Path(sys.prefix) / "share" / "manip_il")
    for place in places:
        if (place / "suites" / "nominal.yaml").is_file():
            return place / "suites"
    raise ManipError(f"the suites' YAML files are missing; looked in {' and '.join(map(str, places))}; install again")
