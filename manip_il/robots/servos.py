"""Numbers of a robot's servos as LeRobot's recorder writes them: joints in degrees, the gripper from 0 to 100."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.errors import ManipError

F64 = NDArray[np.float64]
RATE = 20  # control steps a second of a robot that says no other
_MOST_HZ = 500


@dataclass(frozen=True)
class LeRobotConfig:
    """A robot as LeRobot's recorder knows it.

    robot_type: in `meta/info.json`. names: of its servos, the arm's from base to hand, then the gripper's. gripper:
    where the gripper's driven joint stands at 0 and at 100 [rad]. fps: frames a second.
    """

    robot_type: str
    names: tuple[str, ...]
    gripper: tuple[float, ...]
    fps: int = RATE

    def __post_init__(self) -> None:
        checks.name("robot_type", self.robot_type)
        checks.whole("fps", self.fps, 1, _MOST_HZ)
        if len(set(self.gripper)) != 2:
            raise ManipError(f"gripper is {list(self.gripper)}; expected two places, at 0 and at 100 [rad]")

    def percent(self, joint: F64) -> F64:
        """Return the gripper's numbers, 0 to 100, where its driven joint stands at `joint` [rad]."""
        at_0, at_100 = self.gripper
        return 100 * (joint - at_0) / (at_100 - at_0)


@dataclass(frozen=True, eq=False)
class ServoUnits:
    """The way from [rad] and [m] to degrees and 0 to 100, and back.

    openings: of the gripper [m], rising, (c,). percents: its servo's numbers there, 0 to 100, (c,).
    """

    openings: F64
    percents: F64

    def of(self, arm: F64, opening: float) -> tuple[F64, float]:
        """Return degrees (n - 1,) and the gripper's number, 0 to 100, of joints (n - 1,) [rad] and an opening [m]."""
        return np.degrees(arm), float(np.interp(opening, self.openings, self.percents))

    def back(self, arm: F64, percent: float) -> tuple[F64, float]:
        """Return joints (n - 1,) [rad] and opening [m] of degrees (n - 1,) and the gripper's number, 0 to 100."""
        order = slice(None, None, 1 if self.percents[0] < self.percents[-1] else -1)  # as `interp` takes them
        return np.radians(arm), float(np.interp(percent, self.percents[order], self.openings[order]))
