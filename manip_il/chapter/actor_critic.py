"""Proximal policy optimisation of the `mlp` policy's network, with a separate critic, by stable-baselines3's `PPO`.

(Schulman et al., Proximal policy optimization algorithms, 2017.) The actor is a new network, or that of a clone, with a
new spread of its actions. An iteration is one rollout of whole episodes that all begin and end together, so that only
the weights and the optimiser's state persist between iterations; they are saved as safetensors and JSON.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, override

import numpy as np
import torch
from gymnasium import spaces
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import load_file, save_file
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn
from torch.distributions import Normal

from manip_il.chapter.adversarial_config import PPOConfig
from manip_il.chapter.transitions import F32, Transitions
from manip_il.data.schema import ENVIRONMENT_STATE, STATE, RobotTaskSpec, features
from manip_il.errors import MismatchError, UsageError
from manip_il.learn.action_spaces import Conversion, conversion_for
from manip_il.learn.action_steps import add_steps, is_in_processors
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.lerobot_config import policy_features
from manip_il.learn.losses import MIN_LOG_STD, GaussianHead, floored_log_std
from manip_il.learn.mlp import MLPConfig, MLPPolicy
from manip_il.learn.names import EE_DELTA, MLP
from manip_il.learn.network import MLPNetwork, fit_statistics, perceptron, read_weights

EXTRA = 2  # numbers appended to the policy's inputs: flag of the absorbing state, elapsed share of the episode
_GAUSSIAN = "gaussian"
_CENTRED = ("mse", "l1", _GAUSSIAN)  # losses whose outputs are the mean action
LAST_LR = 0.05  # final learning rate as a share of the first
TARGET_KL = 0.05  # an iteration's passes stop if the KL divergence exceeds 1.5 times this [nats]
_METRICS = {"train/approx_kl": "kl", "train/value_loss": "value_loss", "train/explained_variance": "explained_variance"}


class ActorCritic(ActorCriticPolicy):
    """Actor and critic. Observations (B, d + 2): raw inputs, flag of the absorbing state, elapsed share of the episode.

    The actor sees only the inputs, because it is saved as the policy; the critic sees all, because the return still to
    come depends on the time to the end of the episode. In the absorbing state actions do nothing, so their density is 1
    there and the actor learns nothing from it. The same holds for action dimensions that the demonstrations never vary.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Callable[[float], float],
        network: MLPNetwork,
        width: int = 256,
        **settings: Any,
    ) -> None:
        super().__init__(observation_space, action_space, lr_schedule, **settings)
        inputs = network.input_mean.shape[0] + EXTRA
        self.actor = network
        self.critic = perceptron(inputs, width, 2, 1, nn.Tanh)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=lr_schedule(1), eps=1e-5, fused=True)

    @override
    def _build(self, lr_schedule: Callable[[float], float]) -> None:
        """Do nothing: the base class's networks are not used."""

    @override
    def forward(self, obs: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions (B, n), values (B, 1) and log-densities (B,)."""
        gaussian = self._gaussian(obs)
        actions = gaussian.mean if deterministic else gaussian.sample()
        return actions, self.predict_values(obs), self.log_prob(obs, actions)[0]

    @override
    def evaluate_actions(self, obs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return values (B, 1), log-densities (B,) and entropies (B,) [nats]."""
        return self.predict_values(obs), *self.log_prob(obs, actions)

    def log_prob(self, obs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return log-densities of actions (B, n), and entropies, both (B,) [nats]."""
        gaussian, live = self._gaussian(obs), 1.0 - obs[:, -EXTRA]
        log_prob, entropy = gaussian.log_prob(actions) * self._free, gaussian.entropy() * self._free
        return log_prob.sum(1) * live, entropy.sum(1) * live

    @override
    def predict_values(self, obs: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return values, (B, 1)."""
        live = 1.0 - obs[:, -EXTRA, None]
        return self.critic(torch.cat([self.actor.encode(obs[:, :-EXTRA]) * live, obs[:, -EXTRA:]], dim=1))

    @property
    def head(self) -> GaussianHead:
        """The actor's head, which holds the spread of its actions."""
        assert isinstance(self.actor.head, GaussianHead)
        return self.actor.head

    @property
    def log_std(self) -> Tensor:
        """Log-deviations of the action dimensions that vary, (m,), in normalised units."""
        return floored_log_std(self.head.raw_log_std)[self._free > 0]

    @property
    def spread(self) -> Tensor:
        """Deviations of the action dimensions, (n,), in normalised units; 0 for those that never vary."""
        return floored_log_std(self.head.raw_log_std).exp().detach() * self._free

    @property
    def _free(self) -> Tensor:
        return (self.actor.target_scale > 0).float()

    def _gaussian(self, obs: Tensor) -> Normal:
        mean = self.actor.layers(self.actor.encode(obs[:, :-EXTRA]))
        return Normal(mean, floored_log_std(self.head.raw_log_std).exp(), validate_args=False)


class Learner:
    """An actor, a critic and PPO on `env`, whose episodes all have `horizon` steps.

    log_std: initial log-deviation of the actor, in normalised units. clone: whether the actor starts from a clone.
    """

    def __init__(
        self, network: MLPNetwork, config: PPOConfig, env: VecEnv, horizon: int, log_std: float, *, clone: bool = False
    ):
        if env.num_envs % config.minibatches:
            raise UsageError(
                f"episodes is {env.num_envs}; expected a multiple of ppo.minibatches ({config.minibatches})"
            )
        self.network = network
        raw = MIN_LOG_STD + math.log(math.expm1(max(log_std - MIN_LOG_STD, 1e-3)))  # the inverse of `floored_log_std`
        lr = config.first_lr(clone=clone)
        self.ppo = PPO(
            ActorCritic,
            env,
            learning_rate=lambda remaining: lr * max(LAST_LR, remaining),
            n_steps=horizon,
            batch_size=env.num_envs * horizon // config.minibatches,
            n_epochs=config.epochs,
            gamma=config.discount(clone=clone),
            target_kl=TARGET_KL,
            policy_kwargs={"network": network},
            device="cpu",
        )
        with torch.no_grad():
            self.policy.head.raw_log_std.fill_(raw)
        self._first_spread = self.policy.spread.numpy().copy()
        self.ppo.set_logger(Logger(folder=None, output_formats=[]))  # `configure` would make a folder in /tmp
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
        """Run one episode in every environment; return all steps, grouped by time."""
        env, buffer = self.ppo.env, self.ppo.rollout_buffer
        assert env is not None
        self.ppo._last_obs = np.asarray(env.reset())
        self.ppo._last_episode_starts = np.ones(env.num_envs, dtype=bool)
        self.ppo.collect_rollouts(env, self._callback, buffer, self.ppo.n_steps)
        after = np.concatenate([buffer.observations[1:], np.asarray(self.ppo._last_obs)[None]])
        states, next_states = (rows[..., :-1].reshape(-1, rows.shape[-1] - 1) for rows in (buffer.observations, after))
        actions = np.clip(buffer.actions, *self._bounds).reshape(len(states), -1) * (1.0 - states[:, -1:])
        return Transitions(states.astype(np.float32), actions.astype(np.float32), next_states.astype(np.float32))

    def improve(self, rewards: F32, *, actor: bool = True, remaining: float = 1.0) -> dict[str, float]:
        """Take an iteration's gradient steps, given the rewards (N,) of the steps from `collect`. Returns metrics.

        actor: whether to update the actor as well as the critic. remaining: share of the run that is left; the
        learning rate is multiplied by it, but by no less than `LAST_LR`.
        """
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
        """Return log pi + H of every row, (N,): its action's log-density plus the actor's entropy [nats].

        It is 0 in the absorbing state, where no action is sampled.
        """
        obs = torch.from_numpy(np.pad(rows.states, ((0, 0), (0, EXTRA - 1))))
        with torch.no_grad():
            log_prob, entropy = self.policy.log_prob(obs, torch.from_numpy(rows.actions))
        return (log_prob + entropy).numpy()

    def explored(self, rows: Transitions, rng: np.random.Generator) -> Transitions:
        """Return the N rows; the actions have noise of the actor's initial spread and are clipped to their range."""
        noise = rng.standard_normal(rows.actions.shape, dtype=np.float32) * self._first_spread
        actions = np.clip(rows.actions + noise, *self._bounds) * (1.0 - rows.states[:, -1:])
        return Transitions(rows.states, actions.astype(np.float32), rows.next_states)

    @property
    def _bounds(self) -> tuple[F32, F32]:
        space = self.ppo.action_space
        assert isinstance(space, spaces.Box)
        return space.low, space.high

    def save(self, folder: Path, modules: Mapping[str, Any]) -> None:
        """Write weights and optimiser states to `folder`: of actor and critic, and of `modules` (name -> module)."""
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


def seed_generators(seed: int) -> None:
    """Seed torch's and numpy's global generators, which stable-baselines3 uses."""
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002


def start_conversion(start: Path | None, space: str | None, spec: RobotTaskSpec) -> Conversion:
    """Return the conversion of the actor's actions: as in the clone `start`, else to `space`, by default `ee_delta`.

    Raises `UsageError` if `start` is not an mlp with loss mse, l1 or gaussian, `MismatchError` if it was trained
    for another robot, task or action space, and what `conversion_for` raises.
    """
    if start is None:
        return conversion_for(space or EE_DELTA, spec)
    checkpoint = Checkpoint.open(start)
    if checkpoint.kind != MLP:
        raise UsageError(
            f"{start} is a policy of type {checkpoint.kind!r}; expected an mlp, whose actions have a density"
        )
    if (loss := checkpoint.config["loss"]) not in _CENTRED:
        raise UsageError(f"{start} was trained with loss {loss!r}; expected one of {', '.join(_CENTRED)}")
    checkpoint.check_fits(spec)
    if space not in (None, checkpoint.space):
        raise MismatchError("action space", str(start), checkpoint.space, "--action_space", space)
    return conversion_for(checkpoint.space, spec, checkpoint)


def start_policy(
    start: Path | None, conversion: Conversion, spec: RobotTaskSpec, rows: tuple[F32, F32] | None
) -> MLPPolicy:
    """Return an mlp with a Gaussian loss. rows: raw inputs (N, d) and targets (N, n), for a new mlp's statistics.

    A clone keeps its own statistics and acts as before. New weights are drawn from torch's global generator.
    """
    options = (None if start is None else Checkpoint.open(start).mlp_options) or {}
    options |= {"loss": _GAUSSIAN, "action_space": conversion.space, "grippers": conversion.grippers}
    config = MLPConfig(**{name: value for name, value in options.items() if name != "type"})
    inputs = [STATE, *([ENVIRONMENT_STATE] if spec.environment_state_names else [])]
    config.input_features, config.output_features = policy_features(features(spec), inputs)
    policy = MLPPolicy(config)
    if start is not None:
        policy.model.load_state_dict({**policy.model.state_dict(), **read_weights(start)})
    elif rows is not None:
        inputs = policy.model.expanded(torch.from_numpy(rows[0])).numpy()
        policy.model.set_statistics(fit_statistics(inputs, rows[1], _GAUSSIAN))
    else:
        raise UsageError("no demonstrations and no policy to start from; give --dataset.root=DIR or --init=RUN")
    return policy


def save_policy(policy: MLPPolicy, conversion: Conversion, folder: Path) -> None:
    """Write configuration, weights and processors of an mlp to a new folder, in LeRobot's layout."""
    folder.mkdir()
    policy.save_pretrained(folder)
    processors = make_pre_post_processors(policy.config)
    if is_in_processors(policy.config.type, conversion):
        add_steps(*processors, conversion)
    for processor in processors:
        processor.save_pretrained(folder)
