"""Meaning of a robot's action, number by number."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError, MismatchError, NotFiniteError

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ActionSpace:
    """Names and bounds of an action (n,): joint targets [rad] and, last in `names`, the gripper's opening [m].

    low, high: what commands are clipped to, infinite where a joint turns freely. scale: the longest step of a joint
    target from the measured joint [rad], the whole opening of the gripper [m]. relative: whether a learner's target is
    measured from where the joint is; the gripper's is not. Raises `ManipError` where lengths differ.
    """

    names: tuple[str, ...]
    low: F64
    high: F64
    scale: F64
    relative: NDArray[np.bool_]

    def __post_init__(self) -> None:
        lengths = {name: len(getattr(self, name)) for name in ("names", "low", "high", "scale", "relative")}
        if len(set(lengths.values())) != 1:
            raise ManipError(f"an action space whose parts have different lengths: {lengths}")

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def arm(self) -> NDArray[np.intp]:
        """Indices of the arm's joints, (n - 1,)."""
        return np.flatnonzero(self.relative)

    @cached_property
    def gripper(self) -> int:
        """Index of the gripper's opening."""
        return int(np.flatnonzero(~self.relative)[0])

    def join(self, arm: F64, opening: float) -> F64:
        """Return the action of joint values (n - 1,) [rad] and an opening [m]."""
        action = np.empty(len(self.names))
        action[self.arm] = arm
        action[self.gripper] = opening
        return action

    def clip(self, action: NDArray[np.floating], step: int) -> F64:
        """Return `action` (n,) within the bounds. Raises `MismatchError`, and `NotFiniteError` naming `step`."""
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.low.shape:
            raise MismatchError("action shape", "the policy", action.shape, "the robot", self.low.shape)
        if not np.isfinite(action).all():
            raise NotFiniteError(f"action at step {step} is not finite: {action}")
        return np.minimum(np.maximum(action, self.low), self.high)

    def random_near(self, state: NDArray[np.floating], rng: np.random.Generator) -> F64:
        """Draw joint targets within the longest step of the measured joints in `state` (n,), and any opening."""
        drawn = rng.uniform(-1, 1, len(self.arm)) * self.scale[self.arm]
        opening = rng.uniform(self.low[self.gripper], self.high[self.gripper])
        return self.join(np.asarray(state, dtype=np.float64)[self.arm] + drawn, opening)
