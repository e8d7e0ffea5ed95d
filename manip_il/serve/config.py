"""Settings of servos and of sessions. Importing this module does not load the simulator.

Sources of the servos' values: Feetech's data sheet of the STS3215-C018 (12 V: 30 kg cm at stall, 45
turns per minute without load); gear play of about 1 degree and an error of 1.8 to 2.6 degrees under
1.5 kg at 10 cm (github.com/TheRobotStudio/SO-ARM100, issue 134; robonine.com); friction as in
MuJoCo Menagerie's SO-101. The delay is an assumption.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from manip_il.option import Seeded, option

if TYPE_CHECKING:
    import numpy as np

# values for `--servo=ideal`
IDEAL = {"stiffness": 100.0, "play": 0.0, "delay": 0.0, "friction": 0.0, "offset": 0.0}
# ranges of `--vary=servo`: factors, except for delay [s] and offset [deg], which are added
VARIED = {
    "stiffness": (0.7, 1.3),
    "torque": (0.8, 1.1),
    "speed": (0.8, 1.1),
    "play": (0.3, 1.5),
    "delay": (0.0, 0.03),
    "friction": (0.3, 2.0),
    "offset": (-1.0, 1.0),
}
_ADDED = ("delay", "offset")


@dataclass(frozen=True)
class ServoConfig:
    """Parameters of every servo of an arm."""

    stiffness: float = option(
        27.0, "torque per position error at P_Coefficient 32 [N m/rad]", at_least=1, at_most=1000
    )
    torque: float = option(2.94, "stall torque [N m]", at_least=0.1, at_most=20)
    speed: float = option(4.7, "speed without load [rad/s]", at_least=0.5, at_most=50)
    play: float = option(0.9, "backlash of the gears [deg]", at_least=0, at_most=10)
    delay: float = option(
        0.005, "delay between a command and its effect [s]", at_least=0, at_most=0.5
    )
    friction: float = option(0.052, "friction of the gears [N m]", at_least=0, at_most=2)
    offset: float = option(0.0, "error of each joint's calibration [deg]", at_least=-10, at_most=10)

    def varied(self, rng: np.random.Generator) -> ServoConfig:
        """Draw servos whose parameters differ from these within the ranges of `VARIED`."""
        drawn: dict[str, float] = {}
        for name, ends in VARIED.items():
            own, change = getattr(self, name), rng.uniform(*ends)
            drawn[name] = own + change if name in _ADDED else own * change
        return replace(self, **drawn)


@dataclass(frozen=True)
class SessionConfig(Seeded):
    """Options of a session: how the follower's servos move, when a new world is drawn, and what
    is saved.
    """

    output_dir: Path = option(
        Path("runs/serve"), "folder of the ports follower and leader, and of their calibrations"
    )
    leader: Literal["expert", "sliders", "none"] = option(
        "expert", "who moves the leader arm; sliders: you, in a window"
    )
    speed: float = option(
        1.0,
        "how fast time passes in the world; 2: twice as fast as real time",
        at_least=0.1,
        at_most=10,
    )
    servo: Literal["sts3215", "ideal"] = option(
        "sts3215", "servo model; ideal: without play, delay and friction"
    )
    camera_port: int = option(5599, "TCP port of the cameras (ZMQ)", at_least=1, at_most=65_535)
    reset: Literal["solved", "enter"] = option(
        "solved",
        "when to draw a new world if no COMMAND runs: on Enter, or also one second after the task"
        " is solved",
    )
    intervene: float = option(
        0.15,
        "with LeRobot's DAgger: correct the policy if its targets differ from the expert's by more"
        " than this [rad]",
        at_least=0,
    )
    log: Path | None = option(
        None, "folder for journals with what the client cannot see: states, labels, who drove"
    )
    servos: ServoConfig = field(default_factory=ServoConfig)
    varies: bool = False  # whether to redraw the servos for each world
