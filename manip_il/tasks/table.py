"""The tasks by name."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from manip_il.errors import UnknownName, UsageError
from manip_il.sim.shape import Shape
from manip_il.sim.task import TakesArgument, TakesShape, Task
from manip_il.tasks.carry.task import Carry
from manip_il.tasks.clear_table import ClearTable
from manip_il.tasks.drawer import Drawer
from manip_il.tasks.insert import Insert
from manip_il.tasks.own import GROUP, SUFFIX, packaged, packaged_task, read_task
from manip_il.tasks.pick_place import Lift, PickPlace
from manip_il.tasks.press import Press
from manip_il.tasks.push import Push
from manip_il.tasks.reach import ReachGoal
from manip_il.tasks.sort import Sort
from manip_il.tasks.stack import Stack

TASKS: dict[str, Task] = {
    "reach": ReachGoal(),
    "lift": Lift(),
    "pick_place": PickPlace(),
    "push": Push(),
    "press": Press(),
    "stack": Stack(),
    "drawer": Drawer(),
    "clear_table": ClearTable(),
    "insert": Insert(),
    "insert_tight": Insert("insert_tight", play=0.0005),
    "sort": Sort(),
    "carry": Carry(),
}


def get_task(name: str, shape: str = "") -> Task:
    """Return a task by its name, `NAME` or `NAME:ARGUMENT`, or its Python file, with an object of a shape if given.

    shape: as `Shape.parse` reads it. Raises `UnknownName`, and `UsageError` for a file without a task, and for an
    argument or a shape that is invalid or that the task does not take.
    """
    if name.endswith(SUFFIX):
        task = _of_file(name)
    else:
        base, colon, argument = name.partition(":")
        task = _named(base)
        if colon:
            if not isinstance(task, TakesArgument):
                raise UsageError(f"task is {name!r}, but {base} takes no colon; {_who(TakesArgument)} does")
            task = task.with_argument(argument)
    if shape and not isinstance(task, TakesShape):
        raise UsageError(f"object is {shape!r}, but {name} has objects of its own; it is for {_who(TakesShape)}")
    return _shaped(task, shape) if shape else task


@cache  # the same text gives the same task, so that its scene is built once
def _shaped(task: TakesShape, shape: str) -> Task:
    return task.with_shape(Shape.parse(shape))


def is_task(name: str) -> bool:
    """Return whether a task ships or an installed package provides it, without running anything."""
    base = name.partition(":")[0]
    return base in TASKS or packaged(GROUP, base) is not None


def _of_file(path: str) -> Task:
    task = read_task(Path(path).absolute())
    if task.name in TASKS:
        raise UsageError(f"{path}: its task is called {task.name!r}, as one that ships; choose another name")
    return task


def _named(name: str) -> Task:
    if name in TASKS:
        return TASKS[name]
    if (task := packaged_task(name)) is not None:
        return task
    raise UnknownName("task", name, TASKS, f"known: {', '.join(sorted(TASKS))}, or the path of a Python file")


def _who(protocol: type) -> str:
    return ", ".join(name for name, task in TASKS.items() if isinstance(task, protocol))
