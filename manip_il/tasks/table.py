"""Tasks by name: those that ship, a user's Python file, or a name that an installed package
provides.

A file runs only if the user gives its `Path`, never because a dataset, a checkpoint or a result
names its task: what these store is a `str`, which is a name.
"""

from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from manip_il import checks
from manip_il.errors import UnknownName, UsageError
from manip_il.option import NameOrPath
from manip_il.own_file import own_class
from manip_il.sim.shape import ObjectShape
from manip_il.sim.task import Task
from manip_il.tasks.carry.task import Carry
from manip_il.tasks.clear_table import ClearTable
from manip_il.tasks.drawer import Drawer
from manip_il.tasks.insert import Insert
from manip_il.tasks.pick_place import Lift, PickPlace, ReachGoal
from manip_il.tasks.press import Press
from manip_il.tasks.push import Push
from manip_il.tasks.sort import Sort
from manip_il.tasks.stack import Stack

SUFFIX = ".py"
GROUP = "manip_il.tasks"  # entry-point group: maps a task's name to its class
SHIPPED: tuple[Task, ...] = (
    ReachGoal(),
    Lift(),
    PickPlace(),
    Push(),
    Press(),
    Stack(),
    Drawer(),
    ClearTable(),
    Insert(),
    Insert("insert_tight", play=0.0005),
    Sort(),
    Carry(),
)
TASKS = {task.name: task for task in SHIPPED}


def get_task(name: NameOrPath, shape: NameOrPath = "") -> Task:
    """Return a task by its name, `NAME` or `NAME:ARGUMENT`, or from a file of the user's own.

    Args:
        name: A name or, as `option.typed` returns it, the `Path` of a Python file, or of a
            `carry:reward.json`.
        shape: The object's shape, as `ObjectShape.parse` reads it; empty for the task's default.

    Raises:
        UnknownName: If no task has this name.
        UsageError: If a file has no task, or an argument or a shape is invalid or not taken by the
            task.
    """
    if isinstance(name, Path) and name.suffix == SUFFIX:
        task = _of_file(name.absolute())
    else:
        base, colon, argument = str(name).partition(":")
        task = _named(base)
        if colon:
            task = task.with_argument(Path(argument) if isinstance(name, Path) else argument)
    return _shaped(task, shape) if shape else task


@cache  # the same text gives the same task, so that its scene is built once
def _shaped(task: Task, shape: NameOrPath) -> Task:
    return task.with_shape(ObjectShape.parse(shape))


@cache
def _named(name: str) -> Task:
    if name in TASKS:
        return TASKS[name]
    found = tuple(entry_points(group=GROUP, name=name))
    if not found:
        raise UnknownName("task", name, (*TASKS, "the path of a Python file"))
    return _made(f"task {name} of {found[0].value}", lambda: found[0].load()())


@cache
def _of_file(path: Path) -> Task:
    """Run a file; return its one task."""
    cls = own_class(path, Task, "manip_il.task.Task (docs/new-task.md)")
    task = _made(f"{path}: task {cls.__name__}", cls)
    if task.name in TASKS:
        raise UsageError(
            f"{path}: its task has a built-in task's name, {task.name!r}; choose another"
        )
    return task


def _made(what: str, make: Callable[[], Task]) -> Task:
    try:
        task = make()
        checks.name("its name", task.name)
        _ = task.instruction, task.rungs  # both must be there
    except Exception as error:
        raise UsageError(f"{what}: {checks.one_line(error)}") from error
    return task
