"""Cloning where actions are continuous: linear systems, told apart by what becomes of an error that nobody corrects.

x' = a x + u + w. The expert u = -k x brings every state back by half in a step. Its demonstrations hold little of what
lies beside them, so a clone has no feedback there, and an error goes the way of the open loop: it dies out where that
is stable, as in an arm whose servos hold joint targets, and grows exponentially where it is not. Simchowitz et al.
(2025) prove the latter for smooth deterministic imitators in general; that noise on the demonstrations shows the
expert's corrections is DART (Laskey et al. 2017).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.seeding import rng_for

F64 = NDArray[np.float64]
OPEN_LOOPS = {0.8: "stable", 1.0: "marginal", 1.25: "unstable"}  # a: what becomes of an error that nobody corrects
STEPS, DEMONSTRATIONS, ROLLOUTS = 40, 50, 500
BACK = 0.5  # what the expert leaves of a state in one step
GUST = 1e-3  # standard deviation of what disturbs a rollout, each step
NOISE = 0.1  # standard deviation of the noise on the expert's actions in demonstrations, as DART adds
_LATE = 10  # steps over which the growth is measured, the last ones


@dataclass(frozen=True)
class Drift:
    """Distance of a clone from where the expert would be. pole: a; noise: on the actions of its demonstrations.

    error: of its actions in the expert's states, root mean square; apart: from the expert's states after each step,
    root mean square, (STEPS,).
    """

    pole: float
    noise: float
    error: float
    apart: tuple[float, ...]

    @property
    def growth(self) -> float:
        """Factor by which the clone is farther off after one more step, at the end."""
        return float((self.apart[-1] / self.apart[-1 - _LATE]) ** (1 / _LATE))

    def to_json(self) -> dict[str, Any]:
        """Return everything for a file."""
        return asdict(self) | {"growth": self.growth, "open_loop": OPEN_LOOPS[self.pole]}


def drifts() -> list[Drift]:
    """Return what becomes of a clone on every system, from clean demonstrations and from noisy ones."""
    return [_drift(pole, noise) for pole in OPEN_LOOPS for noise in (0.0, NOISE)]


def _drift(pole: float, noise: float) -> Drift:
    """A clone has a policy for each step, as the theorems have them, linear between the nearest states shown there."""
    rng = rng_for(0, f"linear scalar {pole} {noise}")
    now, shown = rng.uniform(-1, 1, DEMONSTRATIONS), list[F64]()
    for _ in range(STEPS):
        shown.append(np.sort(now))
        now = pole * now + _expert(pole, now) + noise * rng.standard_normal(now.shape)
    apart, errors = list[float](), list[F64]()
    expert = learner = rng.uniform(-1, 1, ROLLOUTS)
    for known in shown:
        gust = GUST * rng.standard_normal(expert.shape)
        on_expert, own = (np.interp(states, known, _expert(pole, known)) for states in (expert, learner))
        errors.append(on_expert - _expert(pole, expert))
        learner = pole * learner + own + gust
        expert = pole * expert + _expert(pole, expert) + gust
        apart.append(_root_mean_square(learner - expert))
    return Drift(pole, noise, _root_mean_square(np.stack(errors)), tuple(apart))


def _expert(pole: float, states: F64) -> F64:
    return (BACK - pole) * states


def _root_mean_square(values: F64) -> float:
    return float(np.sqrt((values**2).mean()))
