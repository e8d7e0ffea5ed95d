"""Proximal policy optimisation of the `mlp` policy's network, by stable-baselines3's `PPO`.

Schulman et al., Proximal policy optimization algorithms, 2017. An iteration is one rollout of whole episodes that all
begin and end together, so that what is between two iterations is weights and the optimiser's state alone, and these
are saved as safetensors and JSON.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state
from safetensors.torch import load_file, save_file
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv

from manip_il.errors import NotFiniteError, UsageError
from manip_il.learn.actor_critic import EXTRA, ActorCritic, set_log_std
from manip_il.learn.adversarial_config import PPOConfig
from manip_il.learn.network import MLPNetwork
from manip_il.learn.transitions import F32, Transitions

LAST_LR = 0.05  # share of the first learning rate that is left at the end
_METRICS = {"train/approx_kl": "kl", "train/value_loss": "value_loss", "train/explained_variance": "explained_variance"}


class Learner:
    """An actor, a critic and PPO over `env`, whose episodes all have `horizon` steps.

    log_std: of the actor's exploration, in normalised units. clone: whether the actor is one, for the defaults.
    """

    def __init__(
        self, network: MLPNetwork, config: PPOConfig, env: VecEnv, horizon: int, log_std: float, *, clone: bool = False
    ):
        if env.num_envs % config.minibatches:
            raise UsageError(
                f"episodes is {env.num_envs}; expected a multiple of ppo.minibatches ({config.minibatches})"
            )
        self.network = network
        set_log_std(network, log_std)
        lr = config.first_lr(clone=clone)
        self.ppo = PPO(
            ActorCritic,
            env,
            learning_rate=lambda remaining: lr * max(LAST_LR, remaining),
            n_steps=horizon,
            batch_size=env.num_envs * horizon // config.minibatches,
            n_epochs=config.epochs,
            gamma=config.discount(clone=clone),
            gae_lambda=config.gae_lambda,
            clip_range=config.clip_range,
            ent_coef=config.entropy,
            target_kl=config.target_kl,
            policy_kwargs={"network": network},
            device="cpu",
        )
        self._first_spread = self.policy.spread.numpy().copy()
        self.ppo.set_logger(configure(None, []))
        self.ppo.ep_info_buffer, self.ppo.ep_success_buffer = deque(maxlen=1), deque(maxlen=1)
        self._callback = CallbackList([])
        self._callback.init_callback(self.ppo)

    @property
    def policy(self) -> ActorCritic:
        """Actor and critic."""
        policy = self.ppo.policy
        assert isinstance(policy, ActorCritic)
        return policy

    def collect(self) -> Transitions:
        """Run one episode in every environment; return all steps, those of a time together."""
        env, buffer = self.ppo.env, self.ppo.rollout_buffer
        assert env is not None
        self.ppo._last_obs = np.asarray(env.reset())
        self.ppo._last_episode_starts = np.ones(env.num_envs, dtype=bool)
        self.ppo.collect_rollouts(env, self._callback, buffer, self.ppo.n_steps)
        self._judge(buffer)
        after = np.concatenate([buffer.observations[1:], np.asarray(self.ppo._last_obs)[None]])
        states, next_states = (rows[..., :-1].reshape(-1, rows.shape[-1] - 1) for rows in (buffer.observations, after))
        actions = np.clip(buffer.actions, *self._bounds).reshape(len(states), -1) * (1.0 - states[:, -1:])
        return Transitions(states.astype(np.float32), actions.astype(np.float32), next_states.astype(np.float32))

    def _judge(self, buffer: RolloutBuffer) -> None:
        """Give the buffer values and log-densities of all its steps, which `ActorCritic.forward` leaves out."""
        given = (buffer.observations, buffer.actions)
        obs, actions = (torch.from_numpy(rows.reshape(-1, rows.shape[-1])) for rows in given)
        with torch.no_grad():
            values, log_probs, _ = self.policy.evaluate_actions(obs, actions)
        buffer.values[:] = values.numpy().reshape(buffer.values.shape)
        buffer.log_probs[:] = log_probs.numpy().reshape(buffer.log_probs.shape)

    def improve(self, rewards: F32, *, actor: bool = True, remaining: float = 1.0) -> dict[str, float]:
        """Take an iteration's gradient steps on what `collect` ran; rewards: (N,) in its order. Returns metrics.

        actor: whether it moves, beside the critic. remaining: share of the run, with which the learning rate falls.
        Raises `NotFiniteError` for a reward that is not finite.
        """
        if not np.isfinite(rewards).all():
            raise NotFiniteError(f"a reward is {rewards[~np.isfinite(rewards)][0]}; expected finite numbers")
        buffer = self.ppo.rollout_buffer
        buffer.rewards[:] = rewards.reshape(buffer.rewards.shape)
        ends = np.ones(buffer.n_envs, dtype=bool)
        buffer.compute_returns_and_advantage(torch.zeros(buffer.n_envs), ends)
        self.network.requires_grad_(actor)
        self.ppo._current_progress_remaining = remaining
        self.ppo.train()
        values = self.ppo.logger.name_to_value
        found = {ours: float(values[theirs]) for theirs, ours in _METRICS.items()}
        return {**found, "log_std": self.policy.log_std.mean().item()}

    def log_prob(self, rows: Transitions) -> F32:
        """Return the log-density of every row's action for the actor, above its mean over actions [nats], (N,).

        That is log pi + H with the entropy H; 0 in the absorbing state, where nothing is drawn.
        """
        obs = torch.from_numpy(np.pad(rows.states, ((0, 0), (0, EXTRA - 1))))
        with torch.no_grad():
            log_prob, entropy = self.policy.log_prob(obs, torch.from_numpy(rows.actions))
        return (log_prob + entropy).numpy()

    def explored(self, rows: Transitions, rng: np.random.Generator) -> Transitions:
        """Return the same rows, N, with noise of the actor's first spread on their actions, within their range."""
        noise = rng.standard_normal(rows.actions.shape, dtype=np.float32) * self._first_spread
        actions = np.clip(rows.actions + noise, *self._bounds) * (1.0 - rows.states[:, -1:])
        return Transitions(rows.states, actions.astype(np.float32), rows.next_states)

    @property
    def _bounds(self) -> tuple[F32, F32]:
        space = self.ppo.action_space
        assert isinstance(space, Box)
        return space.low, space.high

    def save(self, folder: Path, modules: Mapping[str, Any]) -> None:
        """Write weights and optimisers' states of actor, critic and `modules`, by name, into `folder`."""
        for name, module in self._modules(modules).items():
            (folder / name).mkdir()
            save_file(module.state_dict(), folder / name / "weights.safetensors")
            save_optimizer_state(module.optimizer, folder / name)

    def load(self, folder: Path, modules: Mapping[str, Any]) -> None:
        """Read what `save` wrote."""
        for name, module in self._modules(modules).items():
            module.load_state_dict(load_file(folder / name / "weights.safetensors"))
            load_optimizer_state(module.optimizer, folder / name)

    def _modules(self, modules: Mapping[str, Any]) -> dict[str, Any]:
        return {"actor_critic": self.policy, **modules}


@contextmanager
def lent_generators(seed: int) -> Generator[None]:
    """Replace the global generators of torch and numpy, which stable-baselines3 draws from, while the `with` lasts."""
    before = np.random.get_state()  # noqa: NPY002
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        np.random.seed(seed % 2**32)  # noqa: NPY002
        try:
            yield
        finally:
            np.random.set_state(before)  # noqa: NPY002
