"""Cloning where actions are continuous: linear systems, told apart by what becomes of an error that nobody corrects.

x' = A x + u + w. The expert u = -K x brings every state back by half in a step. Its demonstrations hold little of what
lies beside them, so a clone has no feedback there, and an error goes the way of the open loop: it dies out where that
is stable, as in an arm whose servos hold joint targets, and grows exponentially where it is not. Simchowitz et al.
(2025) prove the latter for smooth deterministic imitators in general; that noise on the demonstrations shows the
expert's corrections is DART (Laskey et al. 2017).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from manip_il.seeding import rng_for

F64 = NDArray[np.float64]
STEPS, DEMONSTRATIONS, ROLLOUTS = 40, 50, 500
BACK = 0.5  # what the expert leaves of a state in one step
GUST = 1e-3  # standard deviation of what disturbs a rollout, each step
NOISE = 0.1  # standard deviation of the noise on the expert's actions in demonstrations, as DART adds
_LATE = 10  # steps over which the growth is measured, the last ones


@dataclass(frozen=True)
class System:
    """A linear system. size: scalar, or a plane in which demonstrations stay on a line; pole: of the open loop.

    The pole is that of the direction in which demonstrations say little.
    """

    size: Literal["scalar", "plane"]
    pole: float

    @property
    def open_loop(self) -> F64:
        """Return A, (n, n)."""
        return np.diag([self.pole] if self.size == "scalar" else [0.9, self.pole])

    @property
    def words(self) -> str:
        """Name of what becomes of an error that nobody corrects."""
        return "stable" if self.pole < 1 else "marginal" if self.pole == 1 else "unstable"

    def starts(self, count: int, rng: np.random.Generator) -> F64:
        """Draw first states, (count, n)."""
        at = np.zeros((count, len(self.open_loop)))
        at[:, 0] = rng.uniform(-1, 1, count)
        return at

    def expert(self, states: F64) -> F64:
        """Return the expert's actions, (..., n)."""
        return states @ (BACK * np.eye(len(self.open_loop)) - self.open_loop).T

    def clone(self, shown: F64, states: F64, step: int) -> F64:
        """Return a clone's actions (B, n) in states (B, n), learnt from demonstrated states (STEPS, D, n).

        scalar: a policy for each step, as the theorems have them, linear between the nearest states demonstrated at
        that step. plane: one linear policy by least squares, the smallest of those that fit equally well.
        """
        if self.size == "scalar":
            known = np.sort(shown[step, :, 0])
            return np.interp(states[:, 0], known, self.expert(known[:, None])[:, 0])[:, None]
        rows = shown.reshape(-1, shown.shape[-1])
        return states @ np.linalg.lstsq(rows, self.expert(rows), rcond=1e-9)[0]


SIZES: tuple[Literal["scalar", "plane"], ...] = ("scalar", "plane")
SYSTEMS = tuple(System(size, pole) for size in SIZES for pole in (0.8, 1.0, 1.25))


@dataclass(frozen=True)
class Drift:
    """Distance of a clone from where the expert would be. noise: on the actions of its demonstrations.

    error: of its actions in the expert's states, root mean square; apart: from the expert's states after each step,
    root mean square, (STEPS,); growth: of that in one step, at the end.
    """

    system: System
    noise: float
    error: float
    apart: tuple[float, ...]

    @property
    def growth(self) -> float:
        """Factor by which the clone is farther off after one more step, at the end."""
        return float((self.apart[-1] / self.apart[-1 - _LATE]) ** (1 / _LATE))

    def to_json(self) -> dict[str, Any]:
        """Return everything for a file."""
        return asdict(self) | {"growth": self.growth, "open_loop": self.system.words}


def drifts() -> list[Drift]:
    """Return what becomes of a clone on every system, from clean demonstrations and from noisy ones."""
    return [_drift(system, noise) for system in SYSTEMS for noise in (0.0, NOISE)]


def _drift(system: System, noise: float) -> Drift:
    rng = rng_for(0, f"linear {system.size} {system.pole} {noise}")
    now, shown = system.starts(DEMONSTRATIONS, rng), list[F64]()
    for _ in range(STEPS):
        shown.append(now)
        action = system.expert(now) + noise * rng.standard_normal(now.shape)
        now = now @ system.open_loop.T + action
    demonstrated, apart, errors = np.stack(shown), list[float](), list[F64]()
    expert = learner = system.starts(ROLLOUTS, rng)
    for t in range(STEPS):
        gust = GUST * rng.standard_normal(expert.shape)
        errors.append(system.clone(demonstrated, expert, t) - system.expert(expert))
        learner = learner @ system.open_loop.T + system.clone(demonstrated, learner, t) + gust
        expert = expert @ system.open_loop.T + system.expert(expert) + gust
        apart.append(float(np.sqrt(((learner - expert) ** 2).sum(axis=1).mean())))
    return Drift(system, noise, float(np.sqrt((np.stack(errors) ** 2).sum(axis=2).mean())), tuple(apart))
