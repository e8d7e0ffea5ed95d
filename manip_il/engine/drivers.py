"""Who drives a rollout: the expert, a learner, a mixture of both, or chance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from manip_il.engine.query import Gate, seen
from manip_il.mdp import Actor
from manip_il.policy import Policy
from manip_il.robots.action_space import ActionSpace
from manip_il.rollout import Driver, Turn
from manip_il.seeding import rng_for

F64 = NDArray[np.float64]


class ExpertDriver:
    """Executes the expert's label."""

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return the label of every episode."""
        return [(turn.ask().action, Actor.EXPERT) for turn in turns]


class NoisyExpertDriver:
    """Executes the label with Gaussian noise: DART (Laskey et al. 2017). covariance: (n, n), of actions."""

    def __init__(self, covariance: F64):
        self._covariance = covariance
        self._rngs: dict[int, np.random.Generator] = {}

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return the label plus a draw from each episode's own generator."""
        return [(turn.ask().action + self._draw(turn.seed), Actor.NOISY_EXPERT) for turn in turns]

    def _draw(self, seed: int) -> F64:
        rng = self._rngs.setdefault(seed, rng_for(seed, "dart"))
        return rng.multivariate_normal(np.zeros(len(self._covariance)), self._covariance)


class LearnerDriver:
    """Executes the learner's action, one call a step for all episodes."""

    def __init__(self, policy: Policy):
        self._policy = policy

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return the policy's action in every episode."""
        if started := [turn.seed for turn in turns if turn.step == 0]:
            self._policy.reset(started)
        actions = self._policy.act(*seen(turns, self._policy.cameras), [turn.seed for turn in turns])
        return [(action, Actor.LEARNER) for action in actions]


class MixtureDriver:
    """pi_i = beta_i pi* + (1 - beta_i) pi_hat: each step is the expert's with probability beta (Ross et al. 2011)."""

    def __init__(self, policy: Policy, beta: float):
        self._learner, self._beta = LearnerDriver(policy), beta
        self._rngs: dict[int, np.random.Generator] = {}

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return the learner's or the expert's action, drawn from each episode's own generator."""
        chosen = self._learner.act(turns)
        for i, turn in enumerate(turns):
            rng = self._rngs.setdefault(turn.seed, rng_for(turn.seed, "mixture"))
            if rng.uniform() < self._beta:
                chosen[i] = (turn.ask().action, Actor.EXPERT)
        return chosen


class QueryingDriver:
    """Another driver, and a label where its gate wants one."""

    def __init__(self, driver: Driver, gate: Gate):
        self._driver, self._gate = driver, gate

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """What the other driver does."""
        chosen = self._driver.act(turns)
        for turn, wanted in zip(turns, self._gate(turns, [action for action, _ in chosen]), strict=True):
            if wanted:
                turn.ask()
        return chosen


class TakeoverDriver:
    """The learner drives until its gate wants the expert, who then drives to the end."""

    def __init__(self, learner: Driver, gate: Gate):
        self._learner, self._gate = learner, gate
        self._taken: set[int] = set()

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return the learner's action, or the expert's in episodes that it has taken over."""
        rolling = [turn for turn in turns if turn.seed not in self._taken]
        chosen = dict(zip([turn.seed for turn in rolling], self._learner.act(rolling), strict=True)) if rolling else {}
        wanted = self._gate(rolling, [chosen[turn.seed][0] for turn in rolling]) if rolling else []
        self._taken.update(turn.seed for turn, wants in zip(rolling, wanted, strict=True) if wants)
        return [(turn.ask().action, Actor.EXPERT) if turn.seed in self._taken else chosen[turn.seed] for turn in turns]


class RandomDriver:
    """Joint targets drawn evenly within the longest step of the measured joints, any gripper opening."""

    def __init__(self, actions: ActionSpace):
        self._actions = actions
        self._rngs: dict[int, np.random.Generator] = {}

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return a drawn action for every episode."""
        return [(self._draw(turn), Actor.LEARNER) for turn in turns]

    def _draw(self, turn: Turn) -> F64:
        rng = self._rngs.setdefault(turn.seed, rng_for(turn.seed, "random policy"))
        return self._actions.random_near(turn.observation.state.astype(np.float64), rng)
