"""The tasks by name."""

from __future__ import annotations

from functools import cache

from manip_il.errors import UnknownName, UsageError
from manip_il.sim.shape import Shape
from manip_il.tasks.clear_table import ClearTable
from manip_il.tasks.drawer import Drawer
from manip_il.tasks.insert import Insert
from manip_il.tasks.lift import Lift
from manip_il.tasks.pick_place import PickPlace
from manip_il.tasks.press import Press
from manip_il.tasks.push import Push
from manip_il.tasks.reach import ReachGoal
from manip_il.tasks.sort import Sort
from manip_il.tasks.stack import Stack
from manip_il.tasks.task import TakesShape, Task

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
}


@cache
def get_task(name: str, shape: str = "") -> Task:
    """Return the table's entry, with an object of a shape (`Shape.parse`) where one is given.

    Raises `UnknownName`, and `UsageError` for a shape that cannot be or a task that has objects of its own.
    """
    if name not in TASKS:
        raise UnknownName("task", name, TASKS)
    if not shape:
        return TASKS[name]
    task = TASKS[name]
    if not isinstance(task, TakesShape):
        takers = ", ".join(one for one in TASKS if isinstance(TASKS[one], TakesShape))
        raise UsageError(f"object is {shape!r}, but {name} has objects of its own; it is for {takers}")
    return task.with_shape(Shape.parse(shape))
