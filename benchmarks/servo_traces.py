"""How far the servos of `manip-il serve` are from recordings of a real STS3215.

Usage: python benchmarks/servo_traces.py FOLDER [--fit]

FOLDER has JSON files as github.com/kscalelabs/sysid publishes them (commit 6b78737, folder
`data/feetech/STS_3215_12V_20250317/processed`): one servo swings a pendulum of known mass and
length; goal and position every 5 ms, several gains and trajectories. Prints the mean error of the
position and the lag at P_Coefficient 16, for the default servos and, with `--fit`, for parameters
that are fitted to 60 recordings of two masses, on the other masses, in three minutes.
"""

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from manip_il.calibrate.joint import simulate
from manip_il.mdp import F64, I64
from manip_il.serve.config import ServoConfig

DT, SAMPLES = 0.005, 1000  # time between samples [s], samples of a recording that are used
GRAVITY = 9.81  # [m/s^2]
TILT = -0.06  # angle at which this pendulum hangs [rad]
FITTED = (0.535, 0.969)  # masses whose recordings are fitted [kg]
BOUNDS = {  # of the fit
    "stiffness": (5, 60),
    "torque": (1, 8),
    "damping": (0.05, 4),
    "friction": (0, 0.5),
    "armature": (0.001, 0.08),
    "play": (0, 3),
    "delay": (0, 0.05),
    "speed": (1, 20),
}


class Traces:
    """The recordings, and what the model makes of their goals.

    Args:
        folder: Folder with the recordings, at any depth.
    """

    def __init__(self, folder: Path):
        every = [json.loads(path.read_bytes()) for path in sorted(folder.rglob("*.json"))]
        kept = [
            one
            for one in every
            if len(one["entries"]) >= SAMPLES and one["trajectory"] != "lift_and_drop"
        ]
        self.kinds = np.array([one["trajectory"] for one in kept])
        self.mass, length, self.gain = (
            np.array([one[key] for one in kept], float) for key in ("mass", "length", "kp")
        )
        rod = np.array([one.get("arm_mass", 0.0) for one in kept])
        self._inertia = (self.mass + rod / 3) * length**2
        self._weight = GRAVITY * (self.mass + rod / 2) * length
        self.measured, self.goals = (
            self._column(kept, key) for key in ("position", "goal_position")
        )

    @staticmethod
    def _column(kept: list[dict[str, Any]], key: str) -> F64:
        return np.array([[entry[key] for entry in one["entries"][:SAMPLES]] for one in kept])

    def simulated(self, servo: Mapping[str, float], rows: I64) -> F64:
        """Return the positions of these recordings' goals, (L, T) [rad]."""
        weight = self._weight[rows]
        return simulate(
            {name: np.array(value) for name, value in servo.items()},
            self.goals[rows],
            self.measured[rows, 0],
            DT,
            gain=self.gain[rows],
            inertia=self._inertia[rows],
            load=lambda _, x: weight * np.sin(x + TILT),
        )

    def tell(self, name: str, positions: F64, rows: I64) -> None:
        """Print the error and the lag of positions (L, T) [rad] of these recordings."""
        error = np.abs(positions - self.measured[rows]).mean()
        swings = [
            place
            for place, row in enumerate(rows)
            if self.gain[row] == 16 and self.kinds[row] in ("sin_sin", "sin_time_square")
        ]
        lags = [_lag(self.goals[rows[place]], positions[place]) for place in swings]
        print(f"{name:32s} {error:.4f} rad, lag at P = 16: {1e3 * np.median(lags):.0f} ms")


def _lag(goal: F64, position: F64) -> float:
    goal, position = goal - goal.mean(), position - position.mean()
    errors = [np.abs(goal[: SAMPLES - late] - position[late:]).mean() for late in range(80)]
    return DT * float(np.argmin(errors))


def fit(traces: Traces) -> dict[str, float]:
    """Return the parameters that fit 60 recordings of `FITTED`."""
    rows = np.flatnonzero(np.isin(traces.mass.round(3), FITTED))
    rows = np.random.default_rng(0).permutation(rows)[:60]
    low, high = np.array([*BOUNDS.values()], float).T

    def residuals(scaled: F64) -> F64:
        servo = dict(zip(BOUNDS, low + scaled * (high - low), strict=True)) | {"offset": 0.0}
        return (traces.simulated(servo, rows) - traces.measured[rows])[:, ::10].ravel()

    start = [(asdict(ServoConfig())[name] - a) / (b - a) for name, (a, b) in BOUNDS.items()]
    found = least_squares(
        residuals, start, bounds=(0, 1), loss="soft_l1", f_scale=0.03, diff_step=1e-3, max_nfev=30
    )
    return dict(zip(BOUNDS, low + found.x * (high - low), strict=True)) | {"offset": 0.0}


def main() -> None:
    """Print the table."""
    traces = Traces(Path(sys.argv[1]))
    every = np.arange(len(traces.mass))
    counts = {kind: int((traces.kinds == kind).sum()) for kind in np.unique(traces.kinds).tolist()}
    print(f"{len(every)} recordings: {counts}")
    traces.tell("the servo itself", traces.measured, every)
    default = {name: float(value) for name, value in asdict(ServoConfig()).items()}
    traces.tell("manip-il serve's default", traces.simulated(default, every), every)
    for kind in counts:
        rows = np.flatnonzero(traces.kinds == kind)
        error = np.abs(traces.simulated(default, rows) - traces.measured[rows]).mean()
        print(f"  {kind:30s} {error:.4f} rad")
    if "--fit" in sys.argv:
        servo = fit(traces)
        print({name: round(float(value), 4) for name, value in servo.items()})
        rest = np.flatnonzero(~np.isin(traces.mass.round(3), FITTED))
        traces.tell("fitted, on other masses", traces.simulated(servo, rest), rest)
        traces.tell("fitted, on all", traces.simulated(servo, every), every)


if __name__ == "__main__":
    main()
