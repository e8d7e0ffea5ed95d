"""The interface of a task: its objects, starts and observations, and how the expert solves it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import mujoco
import numpy as np

from manip_il.errors import UsageError, shorten
from manip_il.mdp import F64
from manip_il.option import NameOrPath
from manip_il.robots.robot import Robot
from manip_il.sim.shape import Shape
from manip_il.sim.world import World

Observed = Mapping[str, "F64 | float"]


class Target(NamedTuple):
    """Goal of the expert's next step: a pose of `ee`, position (3,) [m] and rotation (3, 3), and an opening [m].

    max_step, max_turn: how far a single step may aim towards the pose, in position [m] and rotation [rad]. exact: for
    tight fits, keep the posture cost of inverse kinematics from pulling the hand a millimetre off its target.
    lean: how far the hand may lean from `rotation` to reach `position`, 0 to 1.
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
    """A rung: one phase of a task. holds: whether the world is in this phase; target: where the hand moves then."""

    name: str
    holds: Callable[[World], bool]
    target: Callable[[World], Target]


@dataclass(frozen=True)
class Start:
    """Drawn start of an episode. poses: body name -> (position (3,) [m], quaternion wxyz (4,)).

    The bodies are objects and mocap bodies; those without a pose start where `build` put them.
    """

    poses: Mapping[str, tuple[F64, F64]]

    def __post_init__(self) -> None:
        for name, pose in self.poses.items():
            if [np.size(part) for part in pose] != [3, 4]:
                raise UsageError(f"Start: {name} has {shorten(pose)}; expected (position (3,), quaternion wxyz (4,))")


@dataclass(frozen=True)
class Limits:
    """Limits of an episode. tolerance [m], success_steps, horizon [control steps]: as in `Episodes`."""

    tolerance: float = 0.02
    success_steps: int = 5
    horizon: int = 100


class Task(Protocol):
    """A task, independent of the arm.

    objects: what the arm moves and must reach; events move the first. grasped: those that the gripper must go around.
    rungs: the phases, latest first; the expert takes the first that holds, and the last always holds. Each depends only
    on the world, so that the expert can label any state.
    """

    @property
    def name(self) -> str:
        """The task's name in options."""
        ...

    @property
    def instruction(self) -> str:
        """Text for language-conditioned policies; a task whose text differs between episodes is also `Instructing`."""
        ...

    @property
    def limits(self) -> Limits:
        """Limits for solving and ending an episode, unless an environment's settings say otherwise."""
        ...

    @property
    def objects(self) -> tuple[str, ...]:
        """Objects that the arm moves."""
        ...

    @property
    def grasped(self) -> tuple[str, ...]:
        """Objects that the hand grasps."""
        ...

    @property
    def sizes(self) -> tuple[float, float] | None:
        """Range of an object's longest edge that the task can take [m]; None if it takes only its own object."""
        ...

    @property
    def rungs(self) -> tuple[Rung, ...]:
        """The task's phases as rungs, latest first."""
        ...

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the task's objects (free bodies), and furniture and goal markers (mocap bodies)."""
        ...

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw a start within the arm's reach. Raises `UsageError` if there is none."""
        ...

    def observe(self, world: World) -> Observed:
        """Return the entries of `environment_state` by name, in its order: numbers, and vectors of x, y and z."""
        ...

    def error(self, world: World) -> float:
        """Return how far the task is from being solved [m]; within the tolerance it is solved."""
        ...

    def progress(self, world: World) -> float:
        """Return how much of the task is done, 0 to 1; this never falls while the task is done correctly."""
        ...


@runtime_checkable
class Instructing(Protocol):
    """A task whose text differs between episodes; a mocap body's pose in the state encodes the text."""

    def objects_in(self, world: World) -> tuple[str, ...]:
        """Return the objects that the arm must reach: those that the text of the world's episode names."""
        ...

    def instruction_in(self, world: World) -> str:
        """Return the text of the world's present episode."""
        ...


def instruction_in(task: Task, world: World) -> str:
    """Return the text of the world's present episode: the task's instruction, unless texts differ between episodes."""
    return task.instruction_in(world) if isinstance(task, Instructing) else task.instruction


def objects_in(task: Task, world: World) -> tuple[str, ...]:
    """Return the objects that the arm must reach in the world's present episode."""
    return task.objects_in(world) if isinstance(task, Instructing) else task.objects


@runtime_checkable
class TakesShape(Protocol):
    """A task whose object may be of any shape."""

    def with_shape(self, shape: Shape) -> Task:
        """Return this task with an object of the given shape."""
        ...


@runtime_checkable
class TakesArgument(Protocol):
    """A task with variants, called `NAME:ARGUMENT`; the state holds an episode's variant."""

    def with_argument(self, text: NameOrPath) -> Task:
        """Return the variant that a text or a file describes; its name is `NAME` or `NAME:A=NUMBER,B=NUMBER`."""
        ...

    @property
    def argument_bodies(self) -> tuple[str, ...]:
        """Mocap bodies whose places encode the variant; they stay when other places in a scene are drawn anew."""
        ...


@runtime_checkable
class Fitting(Protocol):
    """A task whose fixed parts are scaled to the arm."""

    def fitted(self, robot: Robot) -> Task:
        """Return this task with its fixed parts scaled to the robot."""
        ...


@runtime_checkable
class Refusing(Protocol):
    """A task in which, even with the objects within reach, the expert has no sound label for some states."""

    def unsound(self, world: World) -> str:
        """Return why there is no sound label; empty if there is one."""
        ...


def phases(task: Task) -> tuple[str, ...]:
    """Return the names of a task's phases, in the order of `expert_phase`: `none`, then the rungs, earliest first."""
    return (NO_PHASE, *(rung.name for rung in reversed(task.rungs)))


CUBE_SIZES = (0.03, 0.07)  # edges of a cube that every gripper goes around [m]
NO_PHASE = "none"  # the phase of a state without a sound label
