"""What makes an environment: robot, task, control rate and success, without the simulator."""

from __future__ import annotations

from dataclasses import dataclass

from manip_il.errors import UsageError
from manip_il.option import option

DT_SIM = 0.002  # [s]


@dataclass(frozen=True)
class EnvConfig:
    """Settings of one environment; every field is part of the fingerprint. Raises `UsageError` for a wrong number."""

    robot: str = option("panda", "panda or fetch")
    task: str = option("pick_place", "reach, lift or pick_place")
    control_hz: int = option(20, "control steps a second")
    tolerance: float = option(0.02, "distance to the goal that counts as success [m]")
    success_steps: int = option(5, "consecutive control steps within the tolerance that count as success")
    horizon: int = option(100, "control steps in an episode")

    def __post_init__(self) -> None:
        from manip_il.mdp import LONGEST_EPISODE  # here, as help needs no numpy

        if self.control_hz < 1 or round(1 / DT_SIM) % self.control_hz:
            raise UsageError(f"control_hz is {self.control_hz}; expected a divisor of {round(1 / DT_SIM)}")
        if not 0 < self.tolerance < 1:
            raise UsageError(f"tolerance is {self.tolerance} m; expected between 0 and 1")
        if self.horizon > LONGEST_EPISODE:
            raise UsageError(f"horizon is {self.horizon}; expected at most {LONGEST_EPISODE} control steps")
        if self.success_steps < 1 or self.horizon < self.success_steps:
            raise UsageError(f"horizon is {self.horizon}; expected at least success_steps ({self.success_steps}) >= 1")

    @property
    def physics_steps(self) -> int:
        """MuJoCo steps in one control step."""
        return round(1 / (DT_SIM * self.control_hz))
