"""The tasks by name."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Protocol, runtime_checkable

from manip_il.errors import UnknownName, UsageError
from manip_il.sim.shape import Shape
from manip_il.sim.task import TakesShape, Task
from manip_il.tasks.carry import Carry
from manip_il.tasks.clear_table import ClearTable
from manip_il.tasks.drawer import Drawer
from manip_il.tasks.insert import Insert
from manip_il.tasks.lift import Lift
from manip_il.tasks.own import GROUP, SUFFIX, packaged, packaged_task, read_task
from manip_il.tasks.pick_place import PickPlace
from manip_il.tasks.press import Press
from manip_il.tasks.push import Push
from manip_il.tasks.reach import ReachGoal
from manip_il.tasks.reward import Reward
from manip_il.tasks.sort import Sort
from manip_il.tasks.stack import Stack


@runtime_checkable
class TakesReward(Protocol):
    """A task whose way of doing it may be of any taste; what an episode is about lives in the state.

    taste: bodies that hold it, which scenes that are drawn anew of a state keep.
    """

    @property
    def taste(self) -> tuple[str, ...]:
        """Names of the bodies that hold the reward."""
        ...

    def with_reward(self, reward: Reward) -> Task:
        """Return the task with starts that are about a reward."""
        ...


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
    """Return a task by its name, or of a Python file, with an object of a shape and a reward where given.

    shape: as `Shape.parse` reads it. reward: as `Reward.parse` does. Raises `UnknownName`, and `UsageError` for a file
    that holds no task, and for a shape or reward that cannot be or that the task does not take.
    """
    task = _named(name)
    if reward:
        if not isinstance(task, TakesReward):
            raise UsageError(f"reward is {reward!r}, but {name} has one way of doing it; it is for {_who(TakesReward)}")
        task = task.with_reward(Reward.parse(reward))
    if shape:
        if not isinstance(task, TakesShape):
            raise UsageError(f"object is {shape!r}, but {name} has objects of its own; it is for {_who(TakesShape)}")
        task = task.with_shape(Shape.parse(shape))
    return task


def is_task(name: str) -> bool:
    """Return whether a task ships, or an installed package brings it: nothing is run to see that."""
    return name in TASKS or packaged(GROUP, name) is not None


def _named(name: str) -> Task:
    if name in TASKS:
        return TASKS[name]
    if name.endswith(SUFFIX):
        task = read_task(Path(name).absolute())
        if task.name in TASKS:
            raise UsageError(f"{name}: its task is called {task.name!r}, as one that ships; choose another name")
        return task
    if (task := packaged_task(name)) is not None:
        return task
    raise UnknownName("task", name, TASKS, f"known: {', '.join(sorted(TASKS))}, or the path of a Python file")


def _who(protocol: type) -> str:
    return ", ".join(name for name, task in TASKS.items() if isinstance(task, protocol))
