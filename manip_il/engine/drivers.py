"""Who drives a rollout: the expert, a learner, a mixture of both, or chance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError
from manip_il.mdp import Actor
from manip_il.rollout import Turn
from manip_il.seeding import rng_for

F64 = NDArray[np.float64]


class Policy(Protocol):
    """A learner: (B, n) joint states, (B, k) environment states and pictures to (B, n) absolute actions."""

    @property
    def cameras(self) -> Sequence[str]:
        """Whose pictures it looks at."""
        ...

    def act(
        self,
        states: NDArray[np.float32],
        environment_states: NDArray[np.float32],
        images: Mapping[str, NDArray[np.uint8]],
        episodes: Sequence[int],
    ) -> F64:
        """One action a row. images: camera -> (B, H, W, 3); episodes: whose row each is."""
        ...

    def reset(self, episodes: Sequence[int]) -> None:
        """Forget the past of episodes that begin."""
        ...


class ExpertDriver:
    """Executes the expert's label."""

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """The label of every episode. Raises `ManipError` where the expert was not asked."""
        return [(_expert_action(turn), Actor.EXPERT) for turn in turns]


class LearnerDriver:
    """Executes the learner's action, one call a step for all episodes."""

    def __init__(self, policy: Policy):
        self._policy = policy

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """The policy's action in every episode."""
        if started := [turn.seed for turn in turns if turn.step == 0]:
            self._policy.reset(started)
        seen = [turn.observation for turn in turns]
        actions = self._policy.act(
            np.stack([one.state for one in seen]),
            np.stack([one.environment_state for one in seen]),
            {camera: np.stack([one.images[camera] for one in seen]) for camera in self._policy.cameras},
            [turn.seed for turn in turns],
        )
        return [(action, Actor.LEARNER) for action in actions]


class MixtureDriver:
    """pi_i = beta_i pi* + (1 - beta_i) pi_hat: each step is the expert's with probability beta (Ross et al. 2011)."""

    def __init__(self, policy: Policy, beta: float):
        self._learner, self._beta = LearnerDriver(policy), beta
        self._rngs: dict[int, np.random.Generator] = {}

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """The learner's or the expert's action, drawn from each episode's own generator."""
        chosen = self._learner.act(turns)
        for i, turn in enumerate(turns):
            rng = self._rngs.setdefault(turn.seed, rng_for(turn.seed, "mixture"))
            if rng.uniform() < self._beta:
                chosen[i] = (_expert_action(turn), Actor.EXPERT)
        return chosen


class RandomDriver:
    """Joint targets drawn evenly within `reach` [rad] of the measured joints, any gripper opening."""

    def __init__(self, reach: float, max_opening: float):
        self._reach, self._max_opening = reach, max_opening
        self._rngs: dict[int, np.random.Generator] = {}

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """A drawn action for every episode."""
        return [(self._draw(turn), Actor.LEARNER) for turn in turns]

    def _draw(self, turn: Turn) -> F64:
        rng = self._rngs.setdefault(turn.seed, rng_for(turn.seed, "random policy"))
        q = turn.observation.state[:-1].astype(np.float64)
        return np.append(q + rng.uniform(-self._reach, self._reach, len(q)), rng.uniform(0, self._max_opening))


def _expert_action(turn: Turn) -> F64:
    if turn.label is None:
        raise ManipError(f"episode {turn.seed}: the expert was to drive at step {turn.step} but was not asked")
    return turn.label.action
