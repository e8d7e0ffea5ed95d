"""Cloning with continuous actions, on linear systems that differ in how an uncorrected error
develops.

x' = a x + u + w. The expert u = -k x halves the state in every step. Its demonstrations cover few
states off its path, so a clone has no feedback there, and an error develops as in the open loop: it
decays if the open loop is stable, as for an arm whose servos hold joint targets, and grows
exponentially otherwise. Simchowitz et al. (2025) prove exponential growth for smooth deterministic
imitators in general. Noise on the demonstrations, which makes the expert show corrections, is DART
(Laskey et al. 2017).
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from manip_il.mdp import F64
from manip_il.seeding import rng_for

OPEN_LOOPS = {0.8: "stable", 1.0: "marginal", 1.25: "unstable"}  # names of the poles a
STEPS = 40
DEMONSTRATIONS = 50
ROLLOUTS = 500
BACK = 0.5  # factor by which the expert shrinks the state in one step
GUST = 1e-3  # standard deviation of a rollout's disturbance in each step
NOISE = 0.1  # standard deviation of DART's noise on the expert's actions in demonstrations
_LATE = 10  # the growth is measured over this many final steps


@dataclass(frozen=True)
class Drift:
    """Distance between a clone's and the expert's states.

    Attributes:
        pole: The factor a in the module's x' = a x + u + w.
        noise: Standard deviation of the noise on demonstrated actions.
        error: Root mean square error of the clone's actions in the expert's states.
        apart: Root mean square distance from the expert's states after each step, (STEPS,).
    """

    pole: float
    noise: float
    error: float
    apart: tuple[float, ...]

    @property
    def growth(self) -> float:
        """Factor by which the distance grows per step, averaged over the last 10 steps."""
        return float((self.apart[-1] / self.apart[-1 - _LATE]) ** (1 / _LATE))

    def to_json(self) -> dict[str, Any]:
        """Return the drift as JSON."""
        return asdict(self) | {"growth": self.growth, "open_loop": OPEN_LOOPS[self.pole]}


def drifts() -> list[Drift]:
    """Return the drift of a clone on every system, for clean and for noisy demonstrations."""
    return [_drift(pole, noise) for pole in OPEN_LOOPS for noise in (0.0, NOISE)]


def _drift(pole: float, noise: float) -> Drift:
    """The drift of a clone with one policy per step, as in the theorems, linear between
    demonstrated states.
    """
    rng = rng_for(0, f"linear scalar {pole} {noise}")
    now, shown = rng.uniform(-1, 1, DEMONSTRATIONS), list[F64]()
    for _ in range(STEPS):
        shown.append(np.sort(now))
        now = pole * now + _expert(pole, now) + noise * rng.standard_normal(now.shape)
    apart, errors = list[float](), list[F64]()
    expert = learner = rng.uniform(-1, 1, ROLLOUTS)
    for known in shown:
        gust = GUST * rng.standard_normal(expert.shape)
        on_expert, own = (
            np.interp(states, known, _expert(pole, known)) for states in (expert, learner)
        )
        errors.append(on_expert - _expert(pole, expert))
        learner = pole * learner + own + gust
        expert = pole * expert + _expert(pole, expert) + gust
        apart.append(_root_mean_square(learner - expert))
    return Drift(pole, noise, _root_mean_square(np.stack(errors)), tuple(apart))


def _expert(pole: float, states: F64) -> F64:
    return (BACK - pole) * states


def _root_mean_square(values: F64) -> float:
    return float(np.sqrt((values**2).mean()))
