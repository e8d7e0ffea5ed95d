"""Environments in lockstep for reinforcement learning: whole episodes of one length, as stable-baselines3 takes them.

Physics alone: no state is kept and no expert is asked. An episode that has ended goes on in an absorbing state, in
which nothing is simulated (see `manip_il.learn.transitions`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, override

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from manip_il.collect.environments import make_env
from manip_il.errors import MismatchError
from manip_il.learn.action_spaces import Conversion
from manip_il.learn.network import MLPNetwork
from manip_il.mdp import Observation
from manip_il.tasks.config import EnvConfig

F32, F64 = NDArray[np.float32], NDArray[np.float64]


class RobotEpisode:
    """One of our environments. hold: control steps from success to the end; None: to the last step in any case."""

    def __init__(self, config: EnvConfig, hold: int | None):
        self._env, self._hold = make_env(config), hold
        self._held = 0

    def start(self, seed: int) -> None:
        """Begin the episode of a seed."""
        self._env.start(seed)
        self._held = 0
        self._begin()

    def inputs(self) -> F32:
        """Return joint and environment state, raw, (n + k,)."""
        return np.concatenate([self._seen.state, self._seen.environment_state])

    def advance(self, action: F64) -> None:
        """Apply joint targets and opening (n,)."""
        self._env.advance(action)
        self._held += self._held > 0 or self._env.solved
        self._begin()

    @property
    def ended(self) -> bool:
        """Whether `hold` steps have passed since success."""
        return self._hold is not None and self._held > self._hold

    @property
    def solved(self) -> bool:
        """Whether the task has been solved at some step."""
        return self._held > 0

    def _begin(self) -> None:
        self._env.begin_step()
        self._seen: Observation = self._env.observe()


@dataclass(frozen=True)
class ActionRange:
    """Mean, scale and range of raw targets, (n,) each: a normalised action y means mean + scale y, within the range."""

    mean: F32
    scale: F32
    low: F32
    high: F32

    @classmethod
    def of(cls, network: MLPNetwork) -> ActionRange:
        """Return the units and the range of a network's targets."""
        names = ("target_mean", "target_scale", "target_low", "target_high")
        return cls(*(getattr(network, name).numpy().copy() for name in names))

    def raw(self, actions: F32) -> F32:
        """Return raw targets (B, n) of normalised actions (B, n)."""
        return np.clip(actions * self.scale + self.mean, self.low, self.high)

    def normalised(self, targets: F32) -> F32:
        """Return normalised actions (B, n) of raw targets (B, n); 0 where a target never changes."""
        safe = np.where(self.scale > 0, self.scale, 1.0)
        return np.where(self.scale > 0, (np.clip(targets, self.low, self.high) - self.mean) / safe, 0.0).astype(
            np.float32
        )

    @property
    def space(self) -> spaces.Box:
        """Normalised actions within the range."""
        low, high = (
            np.where(self.scale > 0, self.normalised(one), sign) for one, sign in ((self.low, -1), (self.high, 1))
        )
        return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


class Lockstep(VecEnv):
    """Episodes of `horizon` steps, side by side. Observations (B, d + 2): inputs, absorbing or not, share of time gone.

    episodes: each a `RobotEpisode`, or what has its methods. conversion: of the policy's raw targets into actions; the
    first of the inputs are the measured joints that it needs. `seeds` are those of the next `reset`. simulated: control
    steps since then. executed: actions (T, B, n) since then.
    """

    def __init__(
        self, episodes: Sequence[Any], actions: ActionRange, horizon: int, conversion: Conversion | None = None
    ):
        self.episodes: Sequence[Any] = list(episodes)
        self.actions, self.horizon, self._conversion = actions, horizon, conversion or Conversion()
        self.seeds: Sequence[int] = range(len(episodes))
        self.simulated, self._step, self._given = 0, 0, np.empty((0, 0), np.float32)
        self._seen = np.empty((0, 0), np.float32)
        self.executed: list[F64] = []
        self.episodes[0].start(0)
        d = len(self.episodes[0].inputs())
        self._width = d + 2
        super().__init__(len(episodes), spaces.Box(-np.inf, np.inf, (d + 2,), np.float32), actions.space)

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Whether each episode has succeeded so far, (B,)."""
        return np.array([one.solved for one in self.episodes])

    @override
    def reset(self) -> F32:
        """Begin the episodes of `seeds`; return observations (B, d + 2). Raises `MismatchError` for another number."""
        if len(self.seeds) != self.num_envs:
            raise MismatchError("number", "environments", self.num_envs, "seeds", len(self.seeds))
        for episode, seed in zip(self.episodes, self.seeds, strict=True):
            episode.start(seed)
        self.simulated, self._step, self.executed = 0, 0, []
        return self._observe()

    @override
    def step_async(self, actions: F32) -> None:
        """Take the actions (B, n) of the next step, normalised."""
        self._given = actions

    @override
    def step_wait(self) -> Any:
        """Advance every episode that is under way; return observations, rewards of 0, dones and infos."""
        targets = self.actions.raw(self._given).astype(np.float32)
        running = [row for row, episode in enumerate(self.episodes) if not episode.ended]
        executed = np.zeros(targets.shape)
        if running:
            joints = self._seen[running, : targets.shape[1]]
            executed[running] = self._conversion.decode(targets[running], joints)
        for row in running:
            self.episodes[row].advance(executed[row])
        self.simulated += len(running)
        self._step += 1
        self.executed.append(executed)
        done = np.full(self.num_envs, self._step >= self.horizon)
        infos: list[dict[str, Any]] = [{} for _ in self.episodes]
        return self._observe(), np.zeros(self.num_envs, np.float32), done, infos

    def _observe(self) -> F32:
        rows = np.zeros((self.num_envs, self._width), np.float32)
        for row, episode in zip(rows, self.episodes, strict=True):
            if episode.ended:
                row[-2] = 1.0
            else:
                row[:-2] = episode.inputs()
        rows[:, -1] = self._step / self.horizon
        self._seen = rows
        return rows

    # What else the interface asks for: nobody uses it here.

    @override
    def close(self) -> None: ...

    @override
    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    @override
    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError(attr_name)

    @override
    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        raise NotImplementedError(method_name)

    @override
    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs
