"""A task: its objects, starts and observations, and how the expert solves it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple, Self

import mujoco
import numpy as np

from manip_il.errors import UsageError, shorten
from manip_il.mdp import F64
from manip_il.option import NameOrPath
from manip_il.robots.robot import Robot
from manip_il.sim.shape import CUBE, ObjectShape
from manip_il.sim.world import World

Observed = Mapping[str, "F64 | float"]


class Target(NamedTuple):
    """Goal of the expert's next step.

    Args:
        position: Of `ee`, (3,) [m].
        rotation: Of `ee`, (3, 3).
        opening: Of the fingers [m].
        max_step: How far a single step may aim towards the position [m].
        max_turn: How far a single step may aim towards the rotation [rad].
        exact: For tight fits: keep the posture cost of inverse kinematics from pulling the hand a
            millimetre off.
        lean: How far the hand may lean from `rotation` to reach `position`, 0 to 1.
    """

    position: F64
    rotation: F64
    opening: float
    max_step: float = 0.12
    max_turn: float = 0.6
    exact: bool = False
    lean: float = 0.0


@dataclass(frozen=True)
class Rung:
    """One phase of a task.

    Args:
        name: The phase's name.
        holds: Whether the world is in this phase.
        target: Where the hand moves then.
    """

    name: str
    holds: Callable[[World], bool]
    target: Callable[[World], Target]


@dataclass(frozen=True)
class Start:
    """Drawn start of an episode.

    Attributes:
        poses: Name of a body -> its position, (3,) [m], and its quaternion wxyz, (4,). The bodies
            are objects and mocap bodies; those without a pose start where `build` put them.
    """

    poses: Mapping[str, tuple[F64, F64]]

    def __post_init__(self) -> None:
        for name, pose in self.poses.items():
            if [np.size(part) for part in pose] != [3, 4]:
                raise UsageError(
                    f"Start: {name} has {shorten(pose)}; expected (position (3,), quaternion wxyz"
                    " (4,))"
                )


class Task(ABC):
    """A task, independent of the arm.

    A subclass sets the first three attributes and defines the abstract methods.

    Each rung depends only on the world, so that the expert can label any state.

    Attributes:
        name: The task's name in options.
        instruction: Text for policies that read language.
        rungs: The phases, latest first; the expert takes the first that holds, and the last always
            holds.
        tolerance: Greatest `error` at which the task is solved [m].
        success_steps: Steps in a row for which it must be solved, at 20 control steps a second.
        horizon: Most control steps of an episode, at 20 a second.
        objects: What the arm moves and must reach; events move the first.
        grasped: Objects that the gripper must go around.
        sizes: Range of an object's longest edge that the task can take [m]; None if it takes only
            its own object.
        shape: The object's, in a task that takes any.
        argument_bodies: Mocap bodies whose places hold the argument of `with_argument`; they stay
            when other places in a scene are drawn anew.
        nouns: Words for objects and places, by name; by default the name itself.
        place: Words for where objects are carried.
        subtasks: Words for phases, by name, in which `{it}` and `{place}` are what is moved and
            where to; by default those of `SUBTASKS`, or the phase's name and what is moved.
    """

    name: str
    instruction: str
    rungs: tuple[Rung, ...]
    tolerance: float = 0.02
    success_steps: int = 5
    horizon: int = 100
    objects: tuple[str, ...] = ()
    grasped: tuple[str, ...] = ()
    sizes: tuple[float, float] | None = None
    shape: ObjectShape = CUBE
    argument_bodies: tuple[str, ...] = ()
    nouns: Mapping[str, str] = MappingProxyType({"goal": "green goal"})
    place: str = "its place"
    subtasks: Mapping[str, str] = MappingProxyType({})

    @abstractmethod
    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the task's objects (free bodies), and furniture and goal markers (mocap bodies)."""

    @abstractmethod
    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw a start within the arm's reach.

        Args:
            rng: Generator to draw from.
            world: The world; its variation is that of the episode.

        Raises:
            UsageError: If there is no start within reach.
        """

    @abstractmethod
    def observe(self, world: World) -> Observed:
        """Return the entries of `environment_state` by name, in its order.

        Each is a number, or a vector of x, y and z.
        """

    @abstractmethod
    def error(self, world: World) -> float:
        """Return how far the task is from being solved [m]; within the tolerance it is solved."""

    @abstractmethod
    def progress(self, world: World) -> float:
        """Return how much of the task is done, 0 to 1.

        This never falls while the task is done correctly.
        """

    def objects_in(self, world: World) -> tuple[str, ...]:
        """Return the objects that the arm must reach in the world's present episode."""
        return self.objects

    def instruction_in(self, world: World) -> str:
        """Return the text of the world's present episode.

        If it varies, a mocap body's pose must encode it.
        """
        return self.instruction

    def noun(self, name: str) -> str:
        """Return the words for an object or a place of a given name."""
        return self.nouns.get(name, name.replace("_", " "))

    def moved(self, world: World, phase: str) -> str:
        """Return the name of what the hand moves or reaches for, or `hand` itself.

        Args:
            world: The world to look at.
            phase: Name of the phase that it is in.
        """
        return self.objects[0] if self.objects else "hand"

    def subtask(self, world: World, phase: str) -> str:
        """Return what the expert does in a phase, in words: "carry the cube to the green goal".

        Args:
            world: The world to look at.
            phase: Name of the phase that it is in.
        """
        words = {**SUBTASKS, **self.subtasks}.get(phase, f"{phase.replace('_', ' ')} {{it}}")
        return words.format(it=f"the {self.noun(self.moved(world, phase))}", place=self.place)

    def unsound(self, world: World) -> str:
        """Return why, even with the objects within reach, there is no sound label.

        Empty if there is one.
        """
        return ""

    def fitted(self, robot: Robot) -> Task:
        """Return this task with its fixed parts scaled to a robot."""
        return self

    def with_shape(self, shape: ObjectShape) -> Self:
        """Return this task with an object of another shape.

        Args:
            shape: The shape.

        Raises:
            UsageError: If the task takes no other object.
        """
        raise UsageError(
            f"object is {shape}, but the objects of {self.name} are fixed; omit --task.object"
        )

    def with_argument(self, text: NameOrPath) -> Self:
        """Return the variant `NAME:ARGUMENT`, whose `name` holds the argument.

        Args:
            text: The argument.

        Raises:
            UsageError: If the task takes no argument.
        """
        raise UsageError(
            f"task is {self.name}:{text}, but {self.name} takes no argument after a colon"
        )


def phases(task: Task) -> tuple[str, ...]:
    """Return the names of a task's phases, in the order of `expert_phase`.

    The first is `none`; the rungs follow, earliest first.
    """
    return (NO_PHASE, *(rung.name for rung in reversed(task.rungs)))


_REACH = "reach for {it}"
SUBTASKS = {
    "approach": _REACH,
    "open": _REACH,
    "descend": _REACH,
    "carry": "carry {it} to {place}",
    "at_goal": "hold {it} at {place}",
    "let_go": "let go of {it}",
    "done": "move away from {it}",
}
CUBE_SIZES = (0.03, 0.07)  # edges of a cube that every gripper goes around [m]
NO_PHASE = "none"  # the phase of a state without a sound label
