"""Meaning of a robot's action, number by number."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import MismatchError, NotFiniteError
from manip_il.mdp import F64


@dataclass(frozen=True, eq=False)
class ActionSpace:
    """Names and bounds of an action (n,): joint targets [rad], then the gripper's opening [m].

    Attributes:
        names: Names of the entries; the gripper is last.
        low: Least command, to which others are clipped, (n,); infinite for a joint that turns
            freely.
        high: Greatest command, likewise, (n,).
        scale: For a joint, the largest step of its target from its measured position [rad]; for the
            gripper, the range of its opening [m]; (n,).
        relative: Whether the entry is the target of a joint, which moves relative to its measured
            position, (n,).
        units: Set for a robot with servos: openings of its gripper [m], rising, (c,), and positions
            of the gripper's servo at these, (c,). `low`, `high`, `scale`, actions and measured
            states are then in degrees, the gripper's from 0 to 100.
    """

    names: tuple[str, ...]
    low: F64
    high: F64
    scale: F64
    relative: NDArray[np.bool_]
    units: tuple[F64, F64] | None = None
    arm: ClassVar[slice] = slice(-1)  # places of the joints in an action
    gripper: ClassVar[int] = -1  # place of the gripper's opening

    def __len__(self) -> int:
        return len(self.names)

    def join(self, arm: F64, opening: float) -> F64:
        """Return the action, or measured state, of joints and an opening, (n,).

        Args:
            arm: Joints, (n - 1,) [rad].
            opening: Opening of the gripper [m].
        """
        if self.units is not None:
            arm, opening = np.degrees(arm), float(np.interp(opening, *self.units))
        action = np.empty(len(self.names))
        action[self.arm] = arm
        action[self.gripper] = opening
        return action

    def split(self, action: F64) -> tuple[F64, float]:
        """Return joint values (n - 1,) [rad] and opening [m] of an action (n,)."""
        arm, gripper = action[self.arm], action[self.gripper]
        if self.units is None:
            return arm, gripper
        openings, percents = self.units
        order = np.argsort(percents)  # rising, as `interp` needs them
        return np.radians(arm), float(np.interp(gripper, percents[order], openings[order]))

    def clip(self, action: NDArray[np.floating], step: int) -> F64:
        """Clip an action to the bounds.

        Args:
            action: The action, (n,).
            step: The control step, for messages.

        Raises:
            MismatchError: If the action has the wrong shape.
            NotFiniteError: If it has NaN or infinite entries.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.low.shape:
            raise MismatchError(
                "action shape", "the policy", action.shape, "the robot", self.low.shape
            )
        if not np.isfinite(action).all():
            raise NotFiniteError(f"action at step {step} is not finite: {action}")
        return np.clip(action, self.low, self.high)

    def random_near(self, state: NDArray[np.floating], rng: np.random.Generator) -> F64:
        """Draw an action (n,) whose `relative` entries are near a state.

        Args:
            state: Measured values, (n,) if there are relative entries, which are drawn within
                `scale` of them; the others are drawn within their bounds, without these from -1 to
                1.
            rng: Generator to draw from.
        """
        near, free = np.flatnonzero(self.relative), np.flatnonzero(~self.relative)
        low, high = np.nan_to_num(self.low, neginf=-1), np.nan_to_num(self.high, posinf=1)
        action = np.empty(len(self))
        action[near] = state[near] + rng.uniform(-1, 1, len(near)) * self.scale[near]
        action[free] = rng.uniform(low[free], high[free])
        return action
