"""The tasks by name."""

from __future__ import annotations

from functools import cache

from manip_il.errors import UnknownName, UsageError
from manip_il.sim.shape import Shape
from manip_il.tasks.carry import Carry
from manip_il.tasks.clear_table import ClearTable
from manip_il.tasks.drawer import Drawer
from manip_il.tasks.insert import Insert
from manip_il.tasks.lift import Lift
from manip_il.tasks.pick_place import PickPlace
from manip_il.tasks.press import Press
from manip_il.tasks.push import Push
from manip_il.tasks.reach import ReachGoal
from manip_il.tasks.reward import Reward
from manip_il.tasks.sort import Sort
from manip_il.tasks.stack import Stack
from manip_il.tasks.task import TakesReward, TakesShape, Task

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


@cache
def get_task(name: str, shape: str = "", reward: str = "") -> Task:
    """Return the table's entry, with an object of a shape (`Shape.parse`) and a reward (`Reward.parse`) where given.

    Raises `UnknownName`, and `UsageError` for a shape or reward that cannot be or that the task does not take.
    """
    if name not in TASKS:
        raise UnknownName("task", name, TASKS)
    task = TASKS[name]
    if reward:
        if not isinstance(task, TakesReward):
            raise UsageError(f"reward is {reward!r}, but {name} has one way of doing it; it is for {_who(TakesReward)}")
        task = task.with_reward(Reward.parse(reward))
    if shape:
        if not isinstance(task, TakesShape):
            raise UsageError(f"object is {shape!r}, but {name} has objects of its own; it is for {_who(TakesShape)}")
        task = task.with_shape(Shape.parse(shape))
    return task


def _who(protocol: type) -> str:
    return ", ".join(name for name, task in TASKS.items() if isinstance(task, protocol))
