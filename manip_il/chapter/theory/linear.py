"""Cloning with continuous actions, on linear systems that differ in how an uncorrected error
develops.

x' = A x + u + w, where x is the deviation from the expert's path. The expert u = K x halves x in
every step. Its demonstrations deviate in few directions (`System.spread`); a clone is the linear
policy of least squares, which does not react to deviations that it was never shown. So it has the
expert's feedback in some directions and none in others:

- In none: an error develops as the open loop A does. It decays if that is stable.
- In some: the clone's closed loop can be unstable although the open loop A and the expert's closed
  loop A + K are both stable, as in the system `coupled`. Simchowitz, Pfrommer & Jadbabaie (2025)
  prove that no smooth deterministic Markovian imitator avoids such growth from expert data alone,
  unless the data is sufficiently spread.

Zhang et al. (2025) give the remedies. Where the open loop is stable, a long enough chunk of actions
is executed without feedback, so that an error decays within it. Otherwise noise on the demonstrated
actions makes the expert show corrections in all directions, as in DART (Laskey et al. 2017).
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from manip_il.mdp import F64
from manip_il.seeding import rng_for

STEPS = 40
DEMONSTRATIONS = 50
ROLLOUTS = 500
BACK = 0.5  # factor by which the expert shrinks the state in one step
GUST = 1e-3  # standard deviation of a rollout's disturbance in each step
NOISE = 0.1  # standard deviation of the noise on the expert's actions in demonstrations
CHUNK = 8  # actions of a chunk, executed without feedback
_LATE = 10  # the growth is measured over this many final steps
Remedy = Literal["none", "chunks", "noise"]
REMEDIES: tuple[Remedy, ...] = ("none", "chunks", "noise")


@dataclass(frozen=True, eq=False)
class System:
    """A linear system, and what the demonstrations on it show.

    Attributes:
        name: How its open loop behaves.
        open_loop: The matrix A in the module's x' = A x + u + w, (n, n).
        spread: Standard deviation of the demonstrations' first states, (n,).
    """

    name: str
    open_loop: F64
    spread: F64

    @property
    def radius(self) -> float:
        """Largest absolute eigenvalue of the open loop, which is stable if it is below 1."""
        return float(np.abs(np.linalg.eigvals(self.open_loop)).max())

    def move(self, states: F64, actions: F64) -> F64:
        """Return the next states (N, n), without disturbance."""
        return states @ self.open_loop.T + actions

    def expert(self, states: F64) -> F64:
        """Return the expert's actions (N, n)."""
        return BACK * states - states @ self.open_loop.T


SYSTEMS = (
    *(
        System(name, np.array([[pole]]), np.zeros(1))
        for name, pole in {"stable": 0.8, "marginal": 1.0, "unstable": 1.25}.items()
    ),
    System("coupled", np.array([[0.3, -1.0], [0.5, 1.2]]), np.array([1.0, 0.0])),
)


@dataclass(frozen=True)
class Drift:
    """Distance between a clone's and the expert's states.

    Attributes:
        system: Name of the system.
        radius: See `System.radius`.
        remedy: What the clone has against compounding errors.
        error: Root mean square error of the clone's actions in the expert's states.
        apart: Root mean square distance from the expert's states after each step, (STEPS,).
    """

    system: str
    radius: float
    remedy: Remedy
    error: float
    apart: tuple[float, ...]

    @property
    def growth(self) -> float:
        """Factor by which the distance grows per step, averaged over the last 10 steps."""
        return float((self.apart[-1] / self.apart[-1 - _LATE]) ** (1 / _LATE))

    def to_json(self) -> dict[str, Any]:
        """Return the drift as JSON."""
        return vars(self) | {"growth": self.growth}


def drifts() -> list[Drift]:
    """Return the drift of a clone on every system, with each remedy in turn."""
    return [_drift(system, remedy) for system in SYSTEMS for remedy in REMEDIES]


def _drift(system: System, remedy: Remedy) -> Drift:
    """The drift of a clone with one policy per step, as in the theorems."""
    rng = rng_for(0, f"linear {system.name} {remedy}")
    length = CHUNK if remedy == "chunks" else 1
    shown, labels = _demonstrations(system, NOISE * (remedy == "noise"), rng)
    apart, errors = list[float](), list[F64]()
    plan = list[F64]()
    expert = learner = system.spread * rng.standard_normal((ROLLOUTS, len(system.spread)))
    for step in range(STEPS):
        if step % length == 0:
            plan = [learner @ _fitted(shown[step], one) for one in labels[step : step + length]]
        errors.append(expert @ _fitted(shown[step], labels[step]) - system.expert(expert))
        gust = GUST * rng.standard_normal(expert.shape)
        learner = system.move(learner, plan[step % length]) + gust
        expert = system.move(expert, system.expert(expert)) + gust
        apart.append(_size(learner - expert))
    return Drift(system.name, system.radius, remedy, _size(np.array(errors)), tuple(apart))


def _demonstrations(
    system: System, noise: float, rng: np.random.Generator
) -> tuple[list[F64], list[F64]]:
    """Demonstrated states and the expert's actions in them, (DEMONSTRATIONS, n) for each step."""
    now = system.spread * rng.standard_normal((DEMONSTRATIONS, len(system.spread)))
    shown, labels = list[F64](), list[F64]()
    for _ in range(STEPS):
        shown.append(now)
        labels.append(system.expert(now))
        now = system.move(now, labels[-1] + noise * rng.standard_normal(now.shape))
    return shown, labels


def _fitted(states: F64, actions: F64) -> F64:
    """The gains of least norm among those of least squares, (n, n)."""
    return np.linalg.lstsq(states, actions)[0].astype(np.float64)


def _size(values: F64) -> float:
    """Root mean square length of vectors (..., n)."""
    return float(np.sqrt((values**2).sum(axis=-1).mean()))
