"""How servos move a joint, in numbers: an STS3215's, and how far servos differ.

The values are a fit to real traces of one STS3215 at 12 V, with a pendulum of several
masses and gains (github.com/kscalelabs/sysid, commit 6b78737; `benchmarks/servo_traces.py` repeats
the comparison). Those traces do not show the backlash, which is about 1 degree elsewhere
(github.com/TheRobotStudio/SO-ARM100, issue 134). The ranges of `VARIED` span what differs between
Feetech's data sheets at 7.4 and 12 V, the parameters that the same source publishes for several
servos, and wear.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np

from manip_il.errors import ManipError
from manip_il.mdp import F64
from manip_il.option import check_bounds, option

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
GAIN = 16  # P_Coefficient that LeRobot sets for a follower
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
# of each joint (without the ending `.pos` of LeRobot's names) and parameter: value, low, high
Servos = Mapping[str, Mapping[str, tuple[float, float, float]]]


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

    def range_of(self, name: str) -> tuple[float, float, float]:
        """Return a parameter's value here, and the ends of its range of `--vary=servo`."""
        own, (low, high) = getattr(self, name), VARIED[name]
        if name in _ADDED:
            return own, own + low, own + high
        return own, own * low, own * high


# of `ServoConfig`, but for the encoder's error
PARAMETERS = tuple(field.name for field in fields(ServoConfig) if field.name != "offset")
BOUNDS: F64 = np.array(
    [
        [field.metadata["at_least"], field.metadata["at_most"]]
        for field in fields(ServoConfig)
        if field.name in PARAMETERS
    ]
).T


def servos_like(config: ServoConfig, joints: Sequence[str]) -> Servos:
    """Return servos that are alike, with the ranges of `VARIED`, for joints by name."""
    ranges = {
        name: tuple(np.clip(config.range_of(name), *ends).tolist())
        for name, ends in zip(PARAMETERS, BOUNDS.T, strict=True)
    }
    return {joint.removesuffix(".pos"): ranges for joint in joints}


def servo_ranges(servos: Servos, joints: Sequence[str]) -> F64:
    """Return values, lower and upper ends, parameters in the order of `PARAMETERS`, (3, n, 8).

    Args:
        servos: The servos.
        joints: Names of the n joints.

    Raises:
        ManipError: If a joint or a parameter is missing or unknown.
        UsageError: If a value is out of the bounds of `ServoConfig`.
    """
    names = [joint.removesuffix(".pos") for joint in joints]
    for what, found, wanted in (
        ("servos", servos, names),
        *((f"servos.{joint}", one, PARAMETERS) for joint, one in servos.items()),
    ):
        if found.keys() != set(wanted):
            said = ", ".join(found) or "nothing"
            raise ManipError(f"{what} has {said}; expected {', '.join(wanted)}")
    table = np.array([[servos[joint][name] for name in PARAMETERS] for joint in names], float)
    for values in table.transpose(0, 2, 1).reshape(-1, len(PARAMETERS)).tolist():
        check_bounds(ServoConfig(**dict(zip(PARAMETERS, values, strict=True))), "servos.")
    return table.transpose(2, 0, 1)


def default_servo() -> F64:
    """Return the parameters of the default servo in the order of `PARAMETERS`, (8,)."""
    return np.array([asdict(ServoConfig())[name] for name in PARAMETERS])
