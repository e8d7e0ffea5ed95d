"""What passes between the parts: states, observations, labels, transitions, episodes.

Every type is frozen and refuses itself on construction when shapes disagree or a value is not
finite. Numpy only. Vectors over joints have length `n` = arm joints + 1: arm [rad], gripper
opening [m].
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError, NotFiniteError

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
LONGEST_EPISODE = 10_000  # control steps; eight minutes at 20 Hz


class Actor(IntEnum):
    """Who drove the robot in a frame."""

    EXPERT = 0
    LEARNER = 1
    NOISY_EXPERT = 2


class Phase(IntEnum):
    """Where in the task the expert takes a state to be: the rung of its ladder of predicates."""

    APPROACH = 0
    DESCEND = 1
    GRASP = 2
    CARRY = 3
    AT_GOAL = 4
    OPEN = 5  # the gripper is closed where it must be open
    NONE = 6  # no sound label


@dataclass(frozen=True, slots=True)
class State:
    """The full, privileged state: enough to restore the simulator exactly.

    physics: MuJoCo's integration state, (p,). goal: [m], (3,) in the world frame.
    step: control steps since reset. streak: control steps in a row within the tolerance.
    ever: whether the episode has succeeded at some step.
    """

    physics: F64
    goal: F64
    step: int = 0
    streak: int = 0
    ever: bool = False

    def __post_init__(self) -> None:
        _require_shape("State.goal", self.goal, (3,))
        require_finite("State.physics", self.physics)
        require_finite("State.goal", self.goal)

    def to_vector(self) -> F64:
        """One flat float64 vector, (p + 6,): the dataset's `sim_state`."""
        return np.concatenate([self.physics, self.goal, [self.step, self.streak, self.ever]])

    @classmethod
    def from_vector(cls, vector: F64) -> State:
        """The inverse of `to_vector`, bit for bit."""
        vector = np.asarray(vector, dtype=np.float64)
        step, streak, ever = vector[-3:]
        return cls(vector[:-6].copy(), vector[-6:-3].copy(), int(step), int(streak), bool(ever))


@dataclass(frozen=True, slots=True)
class Observation:
    """What a learner sees. state: (n,); environment_state: (k,), privileged, for state-based policies."""

    state: F32
    environment_state: F32
    images: dict[str, NDArray[np.uint8]] = field(default_factory=dict)  # camera -> (H, W, 3)

    def __post_init__(self) -> None:
        require_finite("observation.state", self.state)
        require_finite("observation.environment_state", self.environment_state)


@dataclass(frozen=True, slots=True)
class Label:
    """The expert's answer in one state.

    action: joint targets [rad] and gripper command [m], (n,). residual: what the step leaves of
    the hand's pose error, in [0, 1] of the error before it. Where `valid` is false, `reason`
    says why and `action` holds the arm still.
    """

    action: F64
    phase: Phase
    valid: bool
    residual: float
    reason: str = ""

    def __post_init__(self) -> None:
        require_finite("Label.action", self.action)


@dataclass(frozen=True, slots=True)
class Transition:
    """One control step of one episode: all of a dataset's frame.

    `state` and `observation` are from before the step; `reward`, `success`, `done` from after it.
    `success` is: within the tolerance for the required steps in a row, now. `done` marks the last frame.
    """

    seed: int
    step: int
    state: State
    observation: Observation
    label: Label | None
    executed_action: F64
    actor: Actor
    reward: float
    success: bool
    done: bool


@dataclass(frozen=True, eq=False)
class Episode:
    """A finished episode as columns, keyed as the dataset is (without LeRobot's own index columns).

    columns: name -> array (T, ...). seed: the episode's own. success: held the goal for the required steps in a row
    at some time. success_at_end: within the tolerance for the required steps at the last frame.
    """

    seed: int
    columns: dict[str, NDArray[np.generic]]
    success: bool
    success_at_end: bool

    def __post_init__(self) -> None:
        lengths = {key: len(column) for key, column in self.columns.items()}
        if len(set(lengths.values())) != 1:
            raise ManipError(f"episode {self.seed}: columns of different lengths: {lengths}")
        if len(self) == 0:
            raise ManipError(f"episode {self.seed}: no frames")
        for key, column in self.columns.items():
            require_finite(f"episode {self.seed}, {key}", column)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def without_pictures(self) -> Episode:
        """The same without its columns of pictures (T, height, width, 3)."""
        columns = {key: column for key, column in self.columns.items() if column.ndim < 4}
        return self if len(columns) == len(self.columns) else replace(self, columns=columns)


def require_finite(what: str, values: NDArray[np.generic]) -> None:
    """Raise `NotFiniteError` naming `what` and the first bad row, unless every value is finite."""
    if values.dtype.kind != "f":
        return
    if np.isfinite(values).all():
        return
    row = int(np.argwhere(~np.isfinite(values))[0][0])
    where = f"frame {row}" if values.ndim > 1 else f"index {row}"
    raise NotFiniteError(f"{what}: {values[row]} at {where} is not finite")


def _require_shape(what: str, values: NDArray[np.generic], shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        raise ManipError(f"{what} has shape {values.shape}; expected {shape}")
