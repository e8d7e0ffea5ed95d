"""Environments in lockstep for reinforcement learning: whole episodes of equal length, as stable-baselines3 needs them.

They simulate only: no state is stored and no expert is queried. A finished episode continues in an absorbing state,
in which nothing is simulated (see `manip_il.chapter.transitions`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, override

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv

from manip_il.learn.action_spaces import Conversion
from manip_il.learn.network import MLPNetwork
from manip_il.mdp import F32, F64
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import make_env


class RobotEpisode:
    """An episode of our environment. hold: control steps from success to the end; None: success does not end it."""

    def __init__(self, config: EnvConfig, hold: int | None):
        self._env, self._hold = make_env(config), hold
        self._held = 0

    def start(self, seed: int) -> None:
        """Start the episode of a seed."""
        self._env.start(seed)
        self._held = 0

    def inputs(self) -> F32:
        """Return joint and environment state, not normalised, (n + k,)."""
        seen = self._env.observe()
        return np.concatenate([seen.state, seen.environment_state])

    def advance(self, action: F64) -> None:
        """Apply joint targets and the gripper's opening (n,)."""
        self._held += self._env.step(action).solved or self._held > 0

    @property
    def ended(self) -> bool:
        """Whether `hold` steps have passed since success."""
        return self._hold is not None and self._held > self._hold

    @property
    def solved(self) -> bool:
        """Whether the task has been solved at some step."""
        return self._held > 0


@dataclass(frozen=True)
class ActionRange:
    """Mean, scale and range of raw targets, (n,) each. A normalised action y stands for mean + scale y, clipped."""

    mean: F32
    scale: F32
    low: F32
    high: F32

    @classmethod
    def of(cls, network: MLPNetwork) -> ActionRange:
        """Return the scale and range of a network's targets."""
        names = ("target_mean", "target_scale", "target_low", "target_high")
        return cls(*(getattr(network, name).numpy().copy() for name in names))

    def raw(self, actions: F32) -> F32:
        """Return the raw targets (B, n) for normalised actions (B, n)."""
        return np.clip(actions * self.scale + self.mean, self.low, self.high)

    def normalised(self, targets: F32) -> F32:
        """Return the normalised actions (B, n) for raw targets (B, n); 0 for a target that never changes."""
        safe = np.where(self.scale > 0, self.scale, 1.0)
        return np.where(self.scale > 0, (np.clip(targets, self.low, self.high) - self.mean) / safe, 0.0).astype(
            np.float32
        )

    @property
    def space(self) -> spaces.Box:
        """Box of normalised actions within the range."""
        low, high = (
            np.where(self.scale > 0, self.normalised(one), sign) for one, sign in ((self.low, -1), (self.high, 1))
        )
        return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


class Unending(gymnasium.Env[F32, Any]):
    """An episode that never terminates: once finished, it continues in an absorbing state.

    Observations (d + 2,): inputs, whether absorbing, elapsed share of `horizon`. `step` takes what `episode.advance`
    takes, not normalised actions. episode: a `RobotEpisode` or an object with its methods. simulated: control steps
    since `reset`.
    """

    def __init__(self, episode: Any, space: spaces.Box, horizon: int):
        self.episode = episode
        self.action_space = space
        self._horizon = horizon
        self._steps = self.simulated = 0
        episode.start(0)
        self._inputs = len(episode.inputs())
        self.observation_space = spaces.Box(-np.inf, np.inf, (self._inputs + 2,), np.float32)

    @override
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[F32, dict[str, Any]]:
        self.episode.start(seed)
        self._steps = self.simulated = 0
        return self._observe(), {}

    @override
    def step(self, action: F64) -> tuple[F32, float, bool, bool, dict[str, Any]]:
        if not self.episode.ended:
            self.episode.advance(action)
            self.simulated += 1
        self._steps += 1
        return self._observe(), 0.0, False, False, {}

    def _observe(self) -> F32:
        ended = self.episode.ended
        inputs = np.zeros(self._inputs) if ended else self.episode.inputs()
        return np.append(inputs, [ended, self._steps / self._horizon]).astype(np.float32)


class Lockstep(DummyVecEnv):
    """Parallel episodes of equal length. `seed(s)` gives them the seeds s, s + 1, ... at the next `reset`.

    conversion: turns the policy's raw targets into actions, given the measured joints (the first inputs).
    executed: actions (T, B, n) since `reset`.
    """

    envs: list[Unending]

    def __init__(
        self, episodes: Sequence[Any], actions: ActionRange, horizon: int, conversion: Conversion | None = None
    ):
        super().__init__([partial(Unending, episode, actions.space, horizon) for episode in episodes])
        self.range, self._conversion = actions, conversion or Conversion()
        self.executed: list[F64] = []

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Whether each episode has succeeded so far, (B,)."""
        return np.array([one.episode.solved for one in self.envs])

    @property
    def simulated(self) -> int:
        """Control steps of all episodes since `reset`, without absorbing states."""
        return sum(one.simulated for one in self.envs)

    @override
    def reset(self) -> F32:
        """Start the episodes; return observations (B, d + 2), see `Unending`."""
        self.executed = []
        return np.asarray(super().reset())

    @override
    def step_async(self, actions: F32) -> None:
        """Step all episodes with normalised actions (B, n), converted to executed actions in one call."""
        targets = self.range.raw(actions).astype(np.float32)
        running = [row for row, one in enumerate(self.envs) if not one.episode.ended]
        executed = np.zeros(targets.shape)
        if running:
            [seen] = self.buf_obs.values()  # avoids the copy that `_obs_from_buf` makes
            executed[running] = self._conversion.decode(targets[running], seen[running, : targets.shape[1]])
        self.executed.append(executed)
        super().step_async(executed)
