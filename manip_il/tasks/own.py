"""Tasks that do not ship: a user's Python file, or a name that an installed package provides.

A file runs only if the user gives its path, never because a dataset, a checkpoint or a result names its task.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import sys
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from manip_il import checks
from manip_il.errors import ManipError, UsageError
from manip_il.sim.task import Task

SUFFIX = ".py"
GROUP = "manip_il.tasks"  # entry points: a name, and a class that is a task
_FACTS = ("name", "instruction", "limits", "objects", "grasped", "sizes", "rungs")
_FUNCTIONS = ("build", "draw", "observe", "destination", "error", "progress")


@cache
def read_task(path: Path) -> Task:
    """Run a file and return its one task.

    Raises `UsageError` if it cannot be run, has no task class or several, or if its task lacks something.
    """
    if not path.is_file():
        raise UsageError(f"{path} does not exist; expected a Python file with a task of your own")
    module = _run(path)
    own = [one for one in vars(module).values() if inspect.isclass(one) and one.__module__ == module.__name__]
    tasks = [one for one in own if hasattr(one, "rungs") and not one.__name__.startswith("_")]
    if len(tasks) != 1:
        found = ", ".join(one.__name__ for one in tasks) or "none"
        raise UsageError(f"{path} has the tasks {found}; expected exactly one class with `rungs` (docs/new-task.md)")
    return _made(f"{path}: task {tasks[0].__name__}", tasks[0])


@cache
def packaged_task(name: str) -> Task | None:
    """Return the task that an installed package provides under a name; None if there is none.

    Raises `UsageError` if it cannot be imported or is no task.
    """
    found = packaged(GROUP, name)
    return None if found is None else _made(f"task {name} of {found.value}", load(found))


def packaged(group: str, name: str) -> EntryPoint | None:
    """Return the entry point of a group and name; None if there is none."""
    return next(iter(entry_points(group=group, name=name)), None)


def load(entry: EntryPoint) -> Any:
    """Return the object that an entry point names. Raises `UsageError` if it cannot be imported."""
    try:
        return entry.load()
    except Exception as error:
        raise UsageError(f"{entry.name} of {entry.value} cannot be imported: {checks.one_line(error)}") from error


def source_hash(task: Task) -> str:
    """Return the SHA-256 of a task's source file."""
    return hashlib.sha256(Path(inspect.getfile(type(task))).read_bytes()).hexdigest()


def _run(path: Path) -> ModuleType:
    name = f"manip_il_own_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UsageError(f"{path} cannot be read as Python")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look it up there
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        line = getattr(error, "lineno", None) if isinstance(error, SyntaxError) else None
        place = f", line {line}" if line else ""
        raise UsageError(f"{path}{place} cannot be run: {type(error).__name__}: {checks.one_line(error)}") from error
    return module


def _made(what: str, cls: Any) -> Task:
    """The task of a class, checked as far as is possible without a robot."""
    if lacks := [name for name in (*_FACTS, *_FUNCTIONS) if not hasattr(cls, name)]:
        raise UsageError(f"{what} lacks {', '.join(lacks)}; docs/new-task.md says what each is for")
    try:
        task: Any = cls() if inspect.isclass(cls) else cls
        checks.name(f"{what}: its name", task.name)
    except (ManipError, TypeError) as error:
        raise UsageError(str(error) if what in str(error) else f"{what}: {checks.one_line(error)}") from error
    return task
