"""States, observations, labels, transitions and episodes: the types that all packages share.

Every type is frozen, and raises on construction if lengths disagree or a value is not finite. Numpy
only. Vectors over joints have length `n` = arm joints + 1: arm [rad], gripper opening [m].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError, NotFiniteError

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Images = Mapping[str, NDArray[np.uint8]]  # camera -> (B, H, W, 3)
IMAGES = "observation.images."  # prefix of a camera's picture column
# prefix of a camera's keypoint column; stored only with its pictures
KEYPOINTS = "privileged.keypoints."
STATE_EXTRAS = 4  # numbers in a `sim_state` besides physics and variation


class Actor(IntEnum):
    """Who drives the robot in one control step."""

    EXPERT = 0
    LEARNER = 1
    NOISY_EXPERT = 2


@dataclass(frozen=True, slots=True)
class State:
    """The full, privileged state: enough to restore the simulator exactly.

    Attributes:
        physics: MuJoCo's integration state, (p,), including goals and fixed furniture as mocap
            poses.
        variation: Every model parameter that was drawn for the episode, (v,).
        step: Control steps since the reset.
        streak: Consecutive control steps within the tolerance.
        ever: Whether the episode has succeeded at some step.
        seed: The episode's seed, which decides the noise and knocks of its later steps. None in a
            state that was read from a dataset, whose `seed` column has it.
        begun: Whether the knock of the control step that follows, if there is one, has happened
            already.
    """

    physics: F64
    variation: F64
    step: int = 0
    streak: int = 0
    ever: bool = False
    seed: int | None = None
    begun: bool = True

    def __post_init__(self) -> None:
        require_finite("State.physics", self.physics)
        require_finite("State.variation", self.variation)

    def to_vector(self) -> F64:
        """Return one flat float64 vector, (p + v + 4,): the dataset's `sim_state`."""
        tail = [len(self.variation), self.step, self.streak, self.ever]
        return np.concatenate([self.physics, self.variation, tail])

    @classmethod
    def from_vector(cls, vector: F64) -> State:
        """Return the state of a vector (p + v + 4,) from `to_vector`, bit for bit."""
        vector = np.array(vector, dtype=np.float64)
        end = len(vector) - STATE_EXTRAS
        count, step, streak, ever = (int(one) for one in vector[end:])
        return cls(vector[: end - count], vector[end - count : end], step, streak, bool(ever))


@dataclass(frozen=True, slots=True)
class Observation:
    """What a policy observes.

    Attributes:
        state: The measured joints [rad] and gripper opening [m], (n,).
        environment_state: Privileged, for state-based policies, (k,).
        images: Pictures (H, W, 3) by camera.
        instruction: The task in words, for policies that read language.
        keypoints: Named points of the scene in each camera's picture, (K, 3), privileged. The
            numbers are the image coordinates across and down, in [0, 1], and 1 if the point is
            within the picture, else 0.
    """

    state: F32
    environment_state: F32
    images: dict[str, NDArray[np.uint8]] = field(default_factory=dict)  # camera -> (H, W, 3)
    instruction: str = ""
    keypoints: dict[str, F32] = field(default_factory=dict)  # camera -> (K, 3)

    def __post_init__(self) -> None:
        require_finite("observation.state", self.state)
        require_finite("observation.environment_state", self.environment_state)


@dataclass(frozen=True, slots=True)
class Label:
    """The expert's label of one state.

    Attributes:
        action: Joint targets [rad] and gripper command [m], (n,). It holds the arm still if the
            label is not valid.
        phase: Number of the task's phase, 0 for none.
        valid: Whether the expert has an action in this state.
        residual: Fraction of the hand's pose error that remains after the step, in [0, 1].
        reason: Why the label is not valid.
    """

    action: F64
    phase: int
    valid: bool
    residual: float
    reason: str = ""

    def __post_init__(self) -> None:
        require_finite("Label.action", self.action)


@dataclass(frozen=True, slots=True)
class Transition:
    """One control step of one episode: all content of a dataset's frame.

    Attributes:
        seed: The episode's seed.
        step: Control steps since the reset.
        state: The state before the step.
        observation: The observation before the step.
        label: The expert's label of the state before the step; None if there is none.
        executed_action: Joint targets [rad] and gripper command [m] of the step, (n,).
        actor: Who drove the robot.
        reward: The reward after the step.
        success: Whether, after the step, the last `success_steps` steps were all within the
            tolerance.
        done: Whether this is the last frame of the episode.
        progress: The task's progress before the step.
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
    progress: float = 0.0


@dataclass(frozen=True, eq=False)
class Episode:
    """A finished episode as columns, with the dataset's names (without LeRobot's own index
    columns).

    Attributes:
        seed: The episode's seed.
        columns: Arrays (T, ...) by name.
        success: Whether the goal was held, at some time, for the required number of consecutive
            steps.
        success_at_end: Whether it was so at the last frame.
        instruction: The task in words, for policies that read language; empty for the task's own
            text.
        drawn: How the episode's world differed from the nominal one: plain JSON values by the names
            of the ranges.
    """

    seed: int
    columns: dict[str, NDArray[np.generic]]
    success: bool
    success_at_end: bool
    instruction: str = ""
    drawn: Mapping[str, Any] = field(default_factory=dict)

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
        """Return the episode without its columns of pictures (T, height, width, 3) and their
        keypoints.
        """
        columns = {
            key: column
            for key, column in self.columns.items()
            if column.ndim < 4 and not key.startswith(KEYPOINTS)
        }
        return replace(self, columns=columns)


def require_finite(what: str, values: NDArray[np.generic]) -> None:
    """Raise `NotFiniteError` unless all values are finite.

    Args:
        what: The name of the values, for the message.
        values: Numbers (T, ...).

    Raises:
        NotFiniteError: A value is not finite; the message names the first bad row.
    """
    if values.dtype.kind != "f":
        return
    if np.isfinite(values).all():
        return
    place = np.argwhere(~np.isfinite(values))[0]
    where = f"frame {place[0]}" if values.ndim > 1 else f"index {place[0]}"
    raise NotFiniteError(f"{what}: {values[tuple(place)]} at {where} is not finite")
