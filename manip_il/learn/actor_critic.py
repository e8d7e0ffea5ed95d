"""The `mlp` policy's network as the actor of stable-baselines3's on-policy learners, with a critic of its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, override

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor, nn

from manip_il.learn.losses import MIN_LOG_STD, GaussianHead, floored_log_std
from manip_il.learn.network import MLPNetwork

EXTRA = 2  # numbers of an observation behind the policy's inputs: flag of the absorbing state, share of time gone
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class ActorCritic(ActorCriticPolicy):
    """Actor and critic. Observations (B, d + 2): raw inputs, whether the state is absorbing, share of time gone.

    The actor sees the inputs alone, so that it is the policy that is saved; the critic sees all: an episode has a last
    step, before which less is to come. In the absorbing state actions do nothing, so their density is 1 there and
    teaches the actor nothing. The same holds for a number of the action that never changed in the demonstrations.
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
        self.critic = nn.Sequential(
            nn.Linear(inputs, width), _Tanh(), nn.Linear(width, width), _Tanh(), nn.Linear(width, 1)
        )
        self.optimizer = torch.optim.Adam(self.parameters(), lr=lr_schedule(1), eps=1e-5, fused=True)

    @override
    def _build(self, lr_schedule: Callable[[float], float]) -> None:
        """Build nothing: what the base class would make is not used."""

    @override
    def forward(self, obs: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions (B, n), and 0 for values (B, 1) and log-densities (B,).

        Of these there is no need while acting: whoever needs them computes those of many steps at once, in
        `evaluate_actions`.
        """
        mean, log_std = self._gaussian(self._encoded(obs))
        actions = mean if deterministic else mean + log_std.exp() * torch.randn_like(mean)
        return actions, mean.new_zeros((len(mean), 1)), mean.new_zeros(len(mean))

    @override
    def evaluate_actions(self, obs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return values (B, 1), log-densities (B,) and entropies (B,) [nats]."""
        x = self._encoded(obs)
        log_prob, entropy = self._density(x, _live(obs), actions)
        return self._values(x, obs), log_prob, entropy

    def log_prob(self, obs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return log-densities of actions (B, n) and entropies, (B,) both [nats]: `evaluate_actions` without values."""
        return self._density(self._encoded(obs), _live(obs), actions)

    @override
    def predict_values(self, obs: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return values, (B, 1)."""
        return self._values(self._encoded(obs), obs)

    @property
    def log_std(self) -> Tensor:
        """Log-deviations of the numbers of an action that vary, (m,), in normalised units."""
        return floored_log_std(_head(self.actor).raw_log_std)[self._free > 0]

    @property
    def spread(self) -> Tensor:
        """Deviations of the numbers of an action, (n,), in normalised units; 0 if they never change."""
        return floored_log_std(_head(self.actor).raw_log_std).exp().detach() * self._free

    @property
    def _free(self) -> Tensor:
        return (self.actor.target_scale > 0).float()

    def _encoded(self, obs: Tensor) -> Tensor:
        return self.actor.encode(obs[:, :-EXTRA])

    def _gaussian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (B, n) and log-deviations (n,) of actions, for encoded inputs."""
        return self.actor.layers(x), floored_log_std(_head(self.actor).raw_log_std)

    def _density(self, x: Tensor, live: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self._gaussian(x)
        free = self._free
        each = -0.5 * ((actions - mean) * torch.exp(-log_std)).square() - log_std - _HALF_LOG_2PI
        return (each * free).sum(1) * live, ((log_std + 0.5 + _HALF_LOG_2PI) * free).sum() * live

    def _values(self, x: Tensor, obs: Tensor) -> Tensor:
        return self.critic(torch.cat([x * _live(obs).unsqueeze(1), obs[:, -EXTRA:]], dim=1))


class _Tanh(nn.Module):
    """tanh x = 2 / (1 + exp(-2 x)) - 1: torch's sigmoid and two products take a third of the time of its tanh."""

    @override
    def forward(self, x: Tensor) -> Tensor:
        return 2.0 * torch.sigmoid(2.0 * x) - 1.0


def set_log_std(network: MLPNetwork, log_std: float) -> None:
    """Set the log-deviation of every number of an action, in normalised units; at least `MIN_LOG_STD`."""
    raw = MIN_LOG_STD + math.log(math.expm1(max(log_std - MIN_LOG_STD, 1e-3)))
    with torch.no_grad():
        _head(network).raw_log_std.fill_(raw)


def _head(network: MLPNetwork) -> GaussianHead:
    head = network.head
    assert isinstance(head, GaussianHead)
    return head


def _live(obs: Tensor) -> Tensor:
    """1 if the state is not absorbing, (B,)."""
    return 1.0 - obs[:, -EXTRA]
