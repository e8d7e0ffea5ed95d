"""How far the servos of `manip-il serve` are from recordings of a real STS3215.

Usage: python benchmarks/servo_traces.py FOLDER [--fit]

FOLDER has JSON files as github.com/kscalelabs/sysid publishes them (commit 6b78737, folder
`data/feetech/STS_3215_12V_20250317/processed`): one servo swings a pendulum of known mass and
length; goal and position every 5 ms, several gains and trajectories. Prints the mean error of the
position and the lag at P_Coefficient 16, for the default servos and, with `--fit`, for those that
`identify` finds in 60 recordings of two masses, on the other masses.
"""

import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from manip_il.calibrate.servos import Arm, ArmMotion, ServoArm, identify
from manip_il.mdp import F64
from manip_il.robots.servos import GAIN, PARAMETERS, default_servo

FPS, SAMPLES = 200, 1000  # samples a second, and those of a recording that are used
TILT = -0.06  # angle at which this pendulum hangs [rad]
FITTED = (0.535, 0.969)  # masses whose recordings are fitted [kg]
PENDULUM = """<mujoco><option integrator="implicitfast"/><worldbody><body euler="{tilt} 0 0">
<joint name="hinge" axis="1 0 0"/>
<geom type="sphere" size="0.01" pos="0 0 -{length}" mass="{mass}"/>
<geom type="capsule" size="0.002" fromto="0 0 0 0 0 -{length}" mass="{rod}"/>
</body></worldbody><actuator><position joint="hinge"/></actuator></mujoco>"""


class Trace(NamedTuple):
    """One recording.

    Attributes:
        kind: Name of its trajectory.
        mass: Mass at the pendulum's end [kg].
        gain: P_Coefficient.
        motion: Goals and positions, (T, 1) each.
        arm: The pendulum.
    """

    kind: str
    mass: float
    gain: float
    motion: ArmMotion
    arm: ServoArm

    def positions(self, servos: F64, *, quick: bool = False) -> F64:
        """Return the positions of its goals with servos (L, 1, 8), (L, T, 1) [rad]."""
        servos = servos.copy()  # an arm has LeRobot's gain
        servos[..., PARAMETERS.index("stiffness")] *= self.gain / GAIN
        return self.arm.positions(servos, self.motion, quick=quick)


class Pendulums(Arm):
    """The pendulums of recordings as one arm, told apart by their motions."""

    def __init__(self, traces: list[Trace]):
        self.fps = FPS
        self._traces = {id(one.motion): one for one in traces}

    def positions(self, servos: F64, motion: ArmMotion, *, quick: bool = False) -> F64:
        """Return the positions of a recording's goals, (L, T, 1) [rad]."""
        return self._traces[id(motion)].positions(servos, quick=quick)


def read(tree: dict[str, Any]) -> Trace:
    """Return a recording from its JSON."""
    goals, positions = (
        np.array([[entry[key]] for entry in tree["entries"][:SAMPLES]])
        for key in ("goal_position", "position")
    )
    xml = PENDULUM.format(
        tilt=np.degrees(TILT),
        length=tree["length"],
        mass=tree["mass"],
        rod=max(tree.get("arm_mass", 0.0), 1e-6),
    )
    model, first = mujoco.MjSpec.from_string(xml).compile(), np.zeros(1, int)
    arm = ServoArm(model, first, first, FPS)
    motion = ArmMotion(goals, positions)
    return Trace(tree["trajectory"], float(tree["mass"]), float(tree["kp"]), motion, arm)


def tell(name: str, traces: list[Trace], servo: F64 | None) -> None:
    """Print the error and the lag of servos (8,); None for those that were recorded."""
    errors, lags = list[float](), list[float]()
    for one in traces:
        measured = one.motion.positions[:, 0]
        moved = measured if servo is None else one.positions(servo[None, None])[0, :, 0]
        errors.append(float(np.abs(moved - measured).mean()))
        if one.gain == GAIN and one.kind in ("sin_sin", "sin_time_square"):
            lags.append(_lag(one.motion.goals[:, 0], moved))
    lag = f", lag at P = {GAIN}: {1e3 * np.median(lags):.0f} ms" if lags else ""
    print(f"{name:32s} {np.mean(errors):.4f} rad{lag}")


def _lag(goal: F64, position: F64) -> float:
    goal, position = goal - goal.mean(), position - position.mean()
    errors = [np.abs(goal[: SAMPLES - late] - position[late:]).mean() for late in range(80)]
    return float(np.argmin(errors)) / FPS


def main() -> None:
    """Print the table."""
    trees = [json.loads(path.read_bytes()) for path in sorted(Path(sys.argv[1]).rglob("*.json"))]
    traces = [
        read(tree)
        for tree in trees
        if len(tree["entries"]) >= SAMPLES and tree["trajectory"] != "lift_and_drop"
    ]
    print(f"{len(traces)} recordings")
    tell("the servo itself", traces, None)
    tell("manip-il serve's default", traces, default_servo())
    for kind in sorted({one.kind for one in traces}):
        tell(f"  {kind}", [one for one in traces if one.kind == kind], default_servo())
    if "--fit" in sys.argv:
        ours = [one for one in traces if round(one.mass, 3) in FITTED]
        chosen = [ours[place] for place in np.random.default_rng(0).permutation(len(ours))[:60]]
        found = identify(Pendulums(chosen), [one.motion for one in chosen], ["servo"])
        for name, *ends in zip(
            PARAMETERS, found.values[0], found.low[0], found.high[0], strict=True
        ):
            print(f"  {name}: {', '.join(f'{end:.4g}' for end in ends)}")
        rest = [one for one in traces if round(one.mass, 3) not in FITTED]
        tell("fitted, on other masses", rest, found.values[0])
        tell("fitted, on all", traces, found.values[0])


if __name__ == "__main__":
    main()
