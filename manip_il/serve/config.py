"""Settings of servos and of sessions. Importing this module does not load the simulator.

The servos' values are a fit to real traces of one STS3215 at 12 V, with a pendulum of several
masses and gains (github.com/kscalelabs/sysid, commit 6b78737; `benchmarks/servo_traces.py` repeats
the comparison). Those traces do not show the backlash, which is about 1 degree elsewhere
(github.com/TheRobotStudio/SO-ARM100, issue 134). The ranges of `VARIED` span what differs between
Feetech's data sheets at 7.4 and 12 V, the parameters that the same source publishes for several
servos, and wear.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from manip_il.option import NameOrPath, Seeded, option

if TYPE_CHECKING:
    import numpy as np

STS3215, STRONG = "sts3215", "ideal"  # the servos that have names
# values for `--servo=ideal`
IDEAL = {
    "stiffness": 100.0,
    "torque": 2.94,
    "damping": 0.63,
    "speed": 50.0,
    "play": 0.0,
    "delay": 0.0,
    "friction": 0.0,
    "armature": 0.028,
    "offset": 0.0,
}
FACTORY_GAIN = 32  # P_Coefficient of a new servo, at which `stiffness` is specified
# ranges of `--vary=servo`: factors, except for delay [s] and offset [deg], which are added
VARIED = {
    "stiffness": (0.7, 1.3),
    "torque": (0.8, 1.3),
    "damping": (0.7, 1.3),
    "speed": (0.7, 1.3),
    "play": (0.3, 1.5),
    "delay": (-0.015, 0.03),
    "friction": (0.3, 1.5),
    "armature": (0.7, 1.5),
    "offset": (-1.0, 1.0),
}
_ADDED = ("delay", "offset")


@dataclass(frozen=True)
class ServoConfig:
    """Parameters of every servo of an arm."""

    stiffness: float = option(
        33.0, "torque per position error at P_Coefficient 32 [N m/rad]", at_least=1, at_most=1000
    )
    torque: float = option(2.06, "stall torque [N m]", at_least=0.1, at_most=20)
    damping: float = option(1.06, "torque against the motion [N m s/rad]", at_least=0, at_most=20)
    speed: float = option(
        4.8,
        "largest speed of the goal within the servo [rad/s]",
        at_least=0.5,
        at_most=50,
    )
    play: float = option(0.9, "backlash of the gears [deg]", at_least=0, at_most=10)
    delay: float = option(
        0.032, "delay between a command and its effect [s]", at_least=0, at_most=0.5
    )
    friction: float = option(0.22, "dry friction of the gears [N m]", at_least=0, at_most=2)
    armature: float = option(
        0.0162, "inertia of motor and gears at the joint [kg m^2]", at_least=0, at_most=1
    )
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
    servo: NameOrPath = option(
        STS3215,
        f"{STS3215}; {STRONG}: strong and fast, without play, delay and friction; or a file that"
        " `robot identify` wrote",
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
