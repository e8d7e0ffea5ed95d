"""Drivers of rollouts: the expert, the expert with noise, a policy, a mixture of policy and expert,
random actions.

A driver is a small picklable object that a job sends to its worker. In the worker, `start` returns
a function that maps the turns of a step to an action (n,) and an actor for each turn.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, override

import numpy as np

from manip_il.collect.rollout import Act, Turn
from manip_il.learn.checkpoint import Checkpoint
from manip_il.mdp import F64, Actor
from manip_il.robots.action_space import ActionSpace
from manip_il.seeding import rng_for

if TYPE_CHECKING:
    from manip_il.learn.policy import LearnedPolicy


@dataclass(frozen=True)
class Setting:
    """What a driver or query rule knows about its rollouts.

    Attributes:
        actions: The robot's action space.
        horizon: Control steps per episode.
        policies: The driver's loaded policies.
    """

    actions: ActionSpace
    horizon: int
    policies: Sequence[Any] = ()


class Driver:
    """Base class of drivers. They must be picklable.

    Attributes:
        kind: The driver's name in datasets, unless it mixes policy and expert.
        beta: Share of the steps that the expert drives.
        policies: Checkpoints of the driver's policies, the first of which drives.
        trust: Whether to load models and code that the checkpoints name.
        device: Torch device of the policies.
    """

    kind: ClassVar[str]
    beta: float = 0.0
    policies: tuple[Checkpoint, ...] = ()
    trust: bool = False
    device: str = "cpu"

    @property
    def name(self) -> str:
        """The driver's name in datasets."""
        return "mixture" if self.policies and self.beta > 0 else self.kind

    def start(self, setting: Setting) -> Act:
        """Return the function that chooses actions, for the episodes of one process."""
        raise NotImplementedError


@dataclass(frozen=True)
class ExpertDriver(Driver):
    """Executes the expert's label."""

    kind = "expert"
    beta = 1.0

    @override
    def start(self, setting: Setting) -> Act:
        return expert_actions


@dataclass(frozen=True)
class NoisyExpertDriver(Driver):
    """Executes the expert's label plus Gaussian noise, as in DART (Laskey et al. 2017).

    Attributes:
        covariance: Covariance of the noise, (n, n).
    """

    covariance: tuple[tuple[float, ...], ...]
    kind = "noisy_expert"
    beta = 1.0

    @override
    def start(self, setting: Setting) -> Act:
        covariance, rngs = np.asarray(self.covariance), generators("dart")

        def act(turn: Turn) -> tuple[F64, Actor]:
            noise = rngs(turn.seed).multivariate_normal(np.zeros(len(covariance)), covariance)
            return turn.query().action + noise, Actor.NOISY_EXPERT

        return lambda turns: list(map(act, turns))


@dataclass(frozen=True)
class DisturbedDriver(Driver):
    """Executes the expert's label, except where a random action replaces it.

    Attributes:
        moments: A control step from which that happens, by seed.
        steps: Number of control steps for which it then happens.
    """

    moments: Mapping[int, int] = field(default_factory=dict[int, int])
    steps: int = 1
    kind = "disturbed"
    beta = 1.0

    @override
    def start(self, setting: Setting) -> Act:
        draw = setting.actions.random_near

        def act(turn: Turn) -> tuple[F64, Actor]:
            rng = rng_for(turn.seed, "disturbed", turn.step)
            since = turn.step - self.moments.get(turn.seed, turn.step + 1)
            if 0 <= since < self.steps:
                return draw(turn.observation.state, rng), Actor.NOISY_EXPERT
            return turn.query().action, Actor.EXPERT

        return lambda turns: list(map(act, turns))


@dataclass(frozen=True)
class RandomDriver(Driver):
    """Draws joint targets uniformly within the longest step from the measured joints, and any
    gripper opening.
    """

    kind = "random"

    @override
    def start(self, setting: Setting) -> Act:
        draw, rngs = setting.actions.random_near, generators("random policy")
        return lambda turns: [
            (draw(turn.observation.state, rngs(turn.seed)), Actor.LEARNER) for turn in turns
        ]


@dataclass(frozen=True)
class PolicyDriver(Driver):
    """Executes the policy's action or, with probability beta, the expert's.

    This is the mixture pi_i = beta pi* + (1 - beta) pi_hat (Ross et al. 2011).

    Attributes:
        policies: The first one drives; a query rule may compare the others with it.
        beta: Probability at each step that the expert's action is executed.
    """

    kind = "policy"
    policies: tuple[Checkpoint, ...] = ()
    beta: float = 0.0
    trust: bool = False
    device: str = "cpu"

    @classmethod
    def of(cls, *policies: Checkpoint | Path, **settings: Any) -> PolicyDriver:
        """Return the driver of what `Checkpoint.of` opens."""
        return cls(tuple(map(Checkpoint.of, policies)), **settings)

    @override
    def start(self, setting: Setting) -> Act:
        policy, rngs = setting.policies[0], generators("mixture")

        def act(turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
            actions = [(action, Actor.LEARNER) for action in policy_actions(policy, turns)]
            for i, turn in enumerate(turns if self.beta > 0 else ()):
                if rngs(turn.seed).uniform() < self.beta:
                    actions[i] = (turn.query().action, Actor.EXPERT)
            return actions

        return act


def driver_of(name: str | None) -> Driver:
    """Return the random driver for `random`, else the expert."""
    return RandomDriver() if name == "random" else ExpertDriver()


def expert_actions(turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
    """Return the expert's action (n,) in every turn."""
    return [(turn.query().action, Actor.EXPERT) for turn in turns]


def policy_actions(policy: LearnedPolicy, turns: Sequence[Turn]) -> F64:
    """Return a policy's action in every turn, (B, n).

    Its memory is reset when an episode starts.
    """
    if started := {turn.seed: turn.observation.instruction for turn in turns if turn.step == 0}:
        policy.begin(started)
    seen = [turn.observation for turn in turns]
    pictures = {camera: np.stack([one.images[camera] for one in seen]) for camera in policy.cameras}
    states = (
        np.stack([one.state for one in seen]),
        np.stack([one.environment_state for one in seen]),
    )
    return policy.act(*states, pictures, [turn.seed for turn in turns])


def generators(stream: str) -> Callable[[int], np.random.Generator]:
    """Return a function that maps an episode's seed to its random generator in `stream`."""
    return cache(lambda seed: rng_for(seed, stream))
