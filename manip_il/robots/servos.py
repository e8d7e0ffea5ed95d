"""How servos move a joint, in numbers."""

from collections.abc import Mapping, Sequence

import numpy as np

from manip_il import checks
from manip_il.errors import ManipError, UnknownName
from manip_il.mdp import F64
from manip_il.robots import HERE, NAMED_SERVOS

# least and greatest value of every parameter, in the units of `sts3215.yaml`
BOUNDS = {
    "stiffness": (1.0, 1000.0),
    "torque": (0.1, 20.0),
    "damping": (0.0, 20.0),
    "speed": (0.5, 50.0),
    "play": (0.0, 10.0),
    "delay": (0.0, 0.5),
    "friction": (0.0, 2.0),
    "armature": (0.0, 1.0),
}
PARAMETERS = tuple(BOUNDS)
FACTORY_GAIN = 32  # P_Coefficient of a new servo, at which `stiffness` is specified
GAIN = 16  # P_Coefficient that LeRobot sets for a follower
# of each joint (without the ending `.pos` of LeRobot's names) and parameter: value, low, high
Servos = Mapping[str, Mapping[str, tuple[float, float, float]]]


def servos_of(name: str, joints: Sequence[str]) -> Servos:
    """Return servos by their name, one for each joint.

    Args:
        name: A name in `NAMED_SERVOS`.
        joints: Names of the joints.

    Raises:
        UnknownName: If there are no such servos.
    """
    if name not in NAMED_SERVOS:
        raise UnknownName("servo", name, NAMED_SERVOS)
    servo = checks.read_yaml(HERE / f"{name}.yaml", "a servo")
    return {joint.removesuffix(".pos"): servo for joint in joints}


def servo_ranges(servos: Servos, joints: Sequence[str]) -> F64:
    """Return values, lower and upper ends, parameters in the order of `PARAMETERS`, (3, n, 8).

    Args:
        servos: The servos.
        joints: Names of the n joints.

    Raises:
        ManipError: If a joint or a parameter is missing, unknown or out of `BOUNDS`, or a
            value is out of its range.
    """
    names = [joint.removesuffix(".pos") for joint in joints]
    for what, found, wanted in (
        ("servos", servos, names),
        *((f"servos.{joint}", one, PARAMETERS) for joint, one in servos.items()),
    ):
        if found.keys() != set(wanted):
            said = ", ".join(found) or "nothing"
            raise ManipError(f"{what} has {said}; expected {', '.join(wanted)}")
    for joint, one in servos.items():
        for name, ends in one.items():
            for end in ends:
                checks.number(f"servos.{joint}.{name}", end, *BOUNDS[name])
            if not ends[1] <= ends[0] <= ends[2]:
                raise ManipError(f"servos.{joint}.{name} is {[*ends]}; expected [value, low, high]")
    table = np.array([[servos[joint][name] for name in PARAMETERS] for joint in names], float)
    return table.transpose(2, 0, 1)


def default_servo() -> F64:
    """Return the parameters of the usual servo in the order of `PARAMETERS`, (8,)."""
    return servo_ranges(servos_of(NAMED_SERVOS[0], ["joint"]), ["joint"])[0, 0]
