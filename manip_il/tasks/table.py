"""The tasks by name."""

from __future__ import annotations

from manip_il.errors import UnknownName
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
from manip_il.tasks.task import Task

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


def get_task(name: str) -> Task:
    """Return the table's entry; raises `UnknownName`."""
    if name not in TASKS:
        raise UnknownName("task", name, TASKS)
    return TASKS[name]
