"""Proximal policy optimisation of the `mlp` policy's network, with a separate critic, by
stable-baselines3's `PPO`.

(Schulman et al., Proximal policy optimization algorithms, 2017.) The actor is a new network, or
that of a clone, with a new spread of its actions. An iteration is one rollout of whole episodes
that all begin and end together, so that only the weights and the optimiser's state persist between
iterations.
"""

import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from lerobot.policies.factory import make_pre_post_processors
from torch import Tensor, nn
from torch.distributions import Normal

from manip_il.chapter.config import PPOConfig
from manip_il.chapter.episodes import Lockstep, Transitions
from manip_il.data.schema import ENVIRONMENT_STATE, STATE, features
from manip_il.errors import MismatchError, UsageError, requires
from manip_il.learn.action_spaces import Conversion, conversion_for
from manip_il.learn.action_steps import add_steps, is_in_processors
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.lerobot_config import policy_features
from manip_il.learn.losses import MIN_LOG_STD, GaussianHead, floored_log_std
from manip_il.learn.mlp import MLPConfig, MLPPolicy
from manip_il.learn.names import EE_DELTA, MLP
from manip_il.learn.network import (
    MLPNetwork,
    NetworkConfig,
    fit_statistics,
    perceptron,
    read_weights,
)
from manip_il.mdp import F32
from manip_il.worlds.contract import EnvironmentSpec

with requires("reinforcement learning", "'manip_il[rl]'"):
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import Logger

# numbers appended to the policy's inputs: flag of the absorbing state, elapsed share of the episode
EXTRA = 2
_GAUSSIAN = "gaussian"
_CENTRED = ("mse", "l1", _GAUSSIAN)  # losses whose outputs are the mean action
_WIDTH = 256  # units in each of the critic's two hidden layers
LAST_LR = 0.05  # final learning rate as a share of the first
TARGET_KL = 0.05  # an iteration's passes stop if the KL divergence exceeds 1.5 times this [nats]
_METRICS = {
    "train/approx_kl": "kl",
    "train/value_loss": "value_loss",
    "train/explained_variance": "explained_variance",
}


class ActorCritic(nn.Module):
    """Actor and critic.

    Observations (B, d + 2): raw inputs, flag of the absorbing state, elapsed share of the episode.

    The actor sees only the inputs, because it is saved as the policy; the critic sees all, because
    the return still to come depends on the time to the end of the episode. In the absorbing state
    actions do nothing, so their density is 1 there and the actor learns nothing from it. The same
    holds for action dimensions that the demonstrations never vary.

    It has those of the methods of stable-baselines3's `ActorCriticPolicy` that `PPO.train` calls.
    """

    def __init__(
        self,
        _spaces: Any,
        _action_space: Any,
        lr: Callable[[float], float],
        network: MLPNetwork,
        **_: Any,
    ) -> None:
        """Make the critic and the optimiser.

        stable-baselines3 calls this with its own arguments, of which only the learning rate is
        used.

        Args:
            _spaces: Observation space, which the sizes of the network make redundant.
            _action_space: Action space, likewise.
            lr: Maps the share of the run that is left to the learning rate; the optimiser starts at
                `lr(1)`.
            network: The actor.
        """
        super().__init__()
        self.actor = network
        self.critic = perceptron(network.input_mean.shape[0] + EXTRA, _WIDTH, 2, 1, nn.Tanh)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=lr(1), eps=1e-5, fused=True)

    def set_training_mode(self, mode: bool) -> None:
        """Do as `train` does."""
        self.train(mode)

    def evaluate_actions(self, obs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return values (B, 1), log-densities (B,) and entropies (B,) [nats]."""
        return self.values(obs), *self.log_prob(obs, actions)

    def log_prob(self, obs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return log-densities of actions (B, n), and entropies, both (B,) [nats]."""
        gaussian, live = self.gaussian(obs), 1.0 - obs[:, -EXTRA]
        log_prob, entropy = gaussian.log_prob(actions) * self.free, gaussian.entropy() * self.free
        return log_prob.sum(1) * live, entropy.sum(1) * live

    def values(self, obs: Tensor) -> Tensor:
        """Return values, (B, 1)."""
        live = 1.0 - obs[:, -EXTRA, None]
        return self.critic(
            torch.cat([self.actor.encode(obs[:, :-EXTRA]) * live, obs[:, -EXTRA:]], dim=1)
        )

    def gaussian(self, obs: Tensor) -> Normal:
        """Return the distribution of the actions, (B, n)."""
        mean = self.actor.outputs(obs[:, :-EXTRA])
        return Normal(mean, floored_log_std(self.head.raw_log_std).exp(), validate_args=False)

    @property
    def head(self) -> GaussianHead:
        """The actor's head, which holds the spread of its actions."""
        assert isinstance(self.actor.head, GaussianHead)
        return self.actor.head

    @property
    def log_std(self) -> Tensor:
        """Log-deviations of the action dimensions that vary, (m,), in normalised units."""
        return floored_log_std(self.head.raw_log_std)[self.free > 0]

    @property
    def free(self) -> Tensor:
        """1 for the action dimensions that vary, else 0, (n,)."""
        return (self.actor.target_scale > 0).float()


class Learner:
    """An actor, a critic and PPO on `env`."""

    policy: ActorCritic

    def __init__(
        self,
        network: MLPNetwork,
        config: PPOConfig,
        env: Lockstep,
        log_std: float,
        *,
        clone: bool = False,
    ):
        """Make the critic and the optimiser.

        Args:
            network: The actor.
            config: Options of PPO.
            env: Episodes to learn from.
            log_std: Initial log-deviation of the actor, in normalised units.
            clone: Whether the actor starts from a clone.

        Raises:
            UsageError: If the steps do not divide into `config.minibatches`.
        """
        batch = len(env.episodes)
        if batch % config.minibatches:
            raise UsageError(
                f"episodes is {batch}; expected a multiple of ppo.minibatches"
                f" ({config.minibatches})"
            )
        self.env = env
        lr = config.first_lr(clone=clone)
        self.ppo = PPO(
            ActorCritic,  # pyright: ignore[reportArgumentType]
            None,  # pyright: ignore[reportArgumentType]
            learning_rate=lambda remaining: lr * max(LAST_LR, remaining),
            n_steps=env.horizon,
            batch_size=batch * env.horizon // config.minibatches,
            n_epochs=config.epochs,
            gamma=config.discount(clone=clone),
            target_kl=TARGET_KL,
            policy_kwargs={"network": network},
            device="cpu",
            _init_setup_model=False,
        )
        self.ppo.observation_space, self.ppo.action_space = (
            spaces.Box(-np.inf, np.inf, (size,), np.float32)
            for size in (network.inputs + EXTRA, network.n)
        )
        self.ppo.n_envs = batch
        self.ppo._setup_model()
        # `configure` would make a folder in /tmp
        self.ppo.set_logger(Logger(folder=None, output_formats=[]))
        self.policy = self.ppo.policy  # pyright: ignore[reportAttributeAccessIssue]
        # the inverse of `floored_log_std`
        raw = MIN_LOG_STD + math.log(math.expm1(max(log_std - MIN_LOG_STD, 1e-3)))
        with torch.no_grad():
            self.policy.head.raw_log_std.fill_(raw)
            spread = floored_log_std(self.policy.head.raw_log_std).exp() * self.policy.free
        self._first_spread = spread.numpy()
        ends = (network.target_low, network.target_high)
        self._range = [network.encode_targets(end).numpy() for end in ends]  # lowest, highest

    @torch.no_grad()
    def collect(self, seed: int) -> Transitions:
        """Run one episode in every environment.

        Args:
            seed: Seed of the first episode, see `Lockstep.start`.

        Returns:
            All steps, grouped by time.
        """
        env, buffer = self.env, self.ppo.rollout_buffer
        buffer.reset()
        seen = env.start(seed)
        nothing = np.zeros(len(seen))
        for step in range(env.horizon):
            obs = torch.from_numpy(seen)
            actions = self.policy.gaussian(obs).sample()
            values, (log_prob, _) = self.policy.values(obs), self.policy.log_prob(obs, actions)
            buffer.add(seen, actions.numpy(), nothing, nothing + (step == 0), values, log_prob)
            seen = env.step(np.clip(actions.numpy(), *self._range))
        after = np.concatenate([buffer.observations[1:], seen[None]])
        states, next_states = (
            rows[..., :-1].reshape(-1, rows.shape[-1] - 1) for rows in (buffer.observations, after)
        )
        return self._clipped(
            Transitions(states, buffer.actions.reshape(len(states), -1), next_states)
        )

    def improve(
        self, rewards: F32, *, actor: bool = True, remaining: float = 1.0
    ) -> dict[str, float]:
        """Take an iteration's gradient steps.

        Args:
            rewards: Rewards of the steps from `collect`, (N,).
            actor: Whether to update the actor as well as the critic.
            remaining: Share of the run that is left, 0 to 1; the learning rate is multiplied by it,
                but by no less than `LAST_LR`.

        Returns:
            Metrics: `kl`, `value_loss`, `explained_variance`, and the mean `log_std`.
        """
        buffer = self.ppo.rollout_buffer
        buffer.rewards[:] = rewards.reshape(buffer.rewards.shape)
        ends = np.ones(buffer.n_envs, dtype=bool)
        buffer.compute_returns_and_advantage(torch.zeros(buffer.n_envs), ends)
        self.policy.actor.requires_grad_(actor)
        self.ppo._current_progress_remaining = remaining
        self.ppo.train()
        values = self.ppo.logger.name_to_value
        found = {ours: float(values[theirs]) for theirs, ours in _METRICS.items()}
        return {**found, "log_std": self.policy.log_std.mean().item()}

    @torch.no_grad()
    def log_prob(self, rows: Transitions) -> F32:
        """Return log pi + H of every row, (N,): its action's log-density plus the actor's entropy
        [nats].

        It is 0 in the absorbing state, where no action is sampled.
        """
        obs = torch.from_numpy(np.pad(rows.states, ((0, 0), (0, EXTRA - 1))))
        log_prob, entropy = self.policy.log_prob(obs, torch.from_numpy(rows.actions))
        return (log_prob + entropy).numpy()

    def explored(self, rows: Transitions, rng: np.random.Generator) -> Transitions:
        """Return the N rows.

        The actions have noise of the actor's initial spread and are clipped to their range.
        """
        noise = rng.standard_normal(rows.actions.shape, dtype=np.float32) * self._first_spread
        return self._clipped(Transitions(rows.states, rows.actions + noise, rows.next_states))

    def _clipped(self, rows: Transitions) -> Transitions:
        """The rows, with actions clipped to their range, and 0 in the absorbing state."""
        actions = np.clip(rows.actions, *self._range) * (1.0 - rows.states[:, -1:])
        return Transitions(rows.states, actions.astype(np.float32), rows.next_states)


def seed_generators(seed: int) -> None:
    """Seed torch's and numpy's global generators, which stable-baselines3 uses."""
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002


def start_conversion(
    start: Checkpoint | None, space: str | None, spec: EnvironmentSpec
) -> Conversion:
    """Return the conversion of the actor's actions.

    Args:
        start: The clone to start from, whose conversion it is.
        space: Without a clone, the action space; by default `ee_delta`.
        spec: The environment.

    Raises:
        UsageError: If `start` is not an mlp with loss mse, l1 or gaussian.
        MismatchError: If it was trained for another robot, task or action space.
    """
    if start is None:
        return conversion_for(space or EE_DELTA, spec)
    loss = start.config.get("loss")
    if start.kind != MLP or loss not in _CENTRED:
        known = ", ".join(_CENTRED)
        raise UsageError(
            f"{start.path} is of type {start.kind!r}, loss {loss!r}; expected an mlp with loss"
            f" {known}"
        )
    start.check_fits(spec)
    if space not in (None, start.space):
        raise MismatchError("action space", str(start.path), start.space, "--action_space", space)
    return conversion_for(start.space, spec, start)


def start_policy(
    start: Checkpoint | None,
    conversion: Conversion,
    spec: EnvironmentSpec,
    rows: tuple[F32, F32] | None,
) -> MLPPolicy:
    """Return an mlp with a Gaussian loss, whose new weights are drawn from torch's global
    generator.

    Args:
        start: A clone, which keeps its own statistics and acts as before.
        conversion: See `start_conversion`.
        spec: The environment.
        rows: Raw inputs (N, d) and targets (N, n), for the statistics of a policy without a clone.

    Raises:
        UsageError: If neither `start` nor `rows` is given.
    """
    options = asdict(NetworkConfig.of(start.config)) if start else {}
    options |= {
        "loss": _GAUSSIAN,
        "action_space": conversion.space,
        "grippers": conversion.grippers,
    }
    config = MLPConfig(**options)
    inputs = [STATE, *([ENVIRONMENT_STATE] if spec.environment_state_names else [])]
    config.input_features, config.output_features = policy_features(features(spec), inputs)
    policy = MLPPolicy(config)
    if start is not None:
        policy.model.load_state_dict({**policy.model.state_dict(), **read_weights(start.path)})
    elif rows is not None:
        inputs = policy.model.expanded(torch.from_numpy(rows[0])).numpy()
        policy.model.set_statistics(fit_statistics(inputs, rows[1], _GAUSSIAN))
    else:
        raise UsageError(
            "no demonstrations and no policy to start from; give --dataset.root=DIR or --init=RUN"
        )
    return policy


def save_policy(policy: MLPPolicy, conversion: Conversion, folder: Path) -> None:
    """Write the configuration, weights and processors of an mlp in LeRobot's layout.

    Args:
        policy: The policy.
        conversion: Turns the policy's raw targets into actions; saved as steps of the processors if
            they do it for this type of policy.
        folder: Folder to make.

    Raises:
        FileExistsError: If `folder` exists.
    """
    folder.mkdir()
    policy.save_pretrained(folder)
    processors = make_pre_post_processors(policy.config)
    if is_in_processors(policy.config.type, conversion):
        add_steps(*processors, conversion)
    for processor in processors:
        processor.save_pretrained(folder)
