"""Discriminators of adversarial imitation, which tell expert from learner.

Their output is the reward.

Both learn D = P(expert | transition) by logistic loss. GAIL's is any function of state and action
(Ho & Ermon, Generative adversarial imitation learning, NeurIPS 2016). AIRL's has the form

    D = exp f / (exp f + pi(a | s)),    f(s, a, s') = g(s, a) + gamma h(s') - h(s)

so that at the optimum g is a reward up to shaping (Fu, Luo & Levine, Learning robust rewards with
adversarial inverse reinforcement learning, ICLR 2018, equations 4 and 7). The reward of both is log
D - log(1 - D); AIRL's is f - log pi. A g of the state alone does not depend on how an arm moves
(section 5), and can be kept as a reward.

Here, AIRL's pi is divided by exp(-H), where H is its entropy. Otherwise -log pi, whose mean is H,
would reward every step before the absorbing state but none in it, as no action is sampled there,
and f would have to follow every change of H.
"""

import copy
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from manip_il.chapter.config import DiscriminatorConfig
from manip_il.chapter.episodes import Transitions
from manip_il.chapter.reward import RewardNetwork, RewardShape
from manip_il.learn.network import MLPNetwork, perceptron
from manip_il.mdp import F32

LARGEST_REWARD = 10.0
Batch = tuple[Tensor, ...]  # states (B, e), actions (B, n), next states (B, e), log pi (B, 1)


class Discriminator(nn.Module):
    """A discriminator and its optimiser."""

    free: Tensor

    def __init__(
        self, config: DiscriminatorConfig, network: MLPNetwork, gamma: float | None = None
    ) -> None:
        """Make an untrained discriminator.

        Args:
            config: Its sizes and the options of its optimiser.
            network: The actor, which normalises the inputs.
            gamma: Discount per control step in AIRL's f; None for GAIL's form.
        """
        super().__init__()
        self.config = config
        self._normalise = network.encode
        self.register_buffer("free", (network.target_scale > 0).float())
        encoded = len(network.input_mean) + 1
        if not config.state_only:
            self.g = perceptron(encoded + len(self.free), config.width, 2, 1, nn.ReLU)
        else:
            columns = network.numbers + len(self.free)
            unread = tuple(range(network.numbers, columns))
            self.g = RewardNetwork(columns, RewardShape(1, config.width, unread=unread))
            self.g.initialise(torch.default_generator)
            self.absorbing_g = nn.Parameter(torch.zeros(()))  # the inputs there are all 0
        self.h = None if gamma is None else perceptron(encoded, config.width, 2, 1, nn.ReLU)
        self._gamma = gamma or 0.0
        self.optimizer = torch.optim.Adam(self.parameters(), lr=config.lr, fused=True)

    def logits(self, batch: Batch) -> Tensor:
        """Return log D - log(1 - D), (B,)."""
        states, actions, next_states, log_prob = batch
        if isinstance(self.g, RewardNetwork):
            g = self.g.members(states)[0, :, None] + self.absorbing_g * states[:, -1:]
        else:
            g = self.g(torch.cat([states, actions], dim=1))
        if self.h is None:
            return g.squeeze(1)
        return (g + self._gamma * self.h(next_states) - self.h(states) - log_prob).squeeze(1)

    @torch.no_grad()
    def learned(self, network: MLPNetwork, states: F32) -> RewardNetwork:
        """Return a g of the state alone as a reward of raw inputs and actions, which it ignores.

        Args:
            network: The actor.
            states: Raw inputs and the flag of the absorbing state, (N, d + 1), of which those that
                are not absorbing set the reward's range.
        """
        assert isinstance(self.g, RewardNetwork)
        made = copy.deepcopy(self.g)
        made.mean.copy_(network.input_mean[: len(made.mean)])
        made.std.copy_(1 / network.input_scale[: len(made.std)])
        [rewards] = made.members(torch.from_numpy(states[states[:, -1] == 0]))
        made.set_range(rewards)
        return made

    def reward(self, learner: Transitions, log_probs: F32) -> F32:
        """Return the reward of every transition, (N,), clipped to +-10.

        Args:
            learner: Transitions of the learner.
            log_probs: The learner's log-density of each action, (N,), which GAIL ignores.
        """
        with torch.no_grad():
            rewards = self.logits(self._encode(learner, log_probs))
        return rewards.clamp(-LARGEST_REWARD, LARGEST_REWARD).numpy().astype(np.float32)

    def fit(
        self,
        expert: Transitions,
        learner: Transitions,
        log_probs: tuple[F32, F32],
        rng: np.random.Generator,
    ) -> dict[str, float]:
        """Take an iteration's gradient steps.

        Args:
            expert: Transitions of the demonstrations.
            learner: Transitions of the learner's last episodes.
            log_probs: Log-densities, under the learner's policy, of the expert's and of the
                learner's actions, (N,) each, which GAIL ignores.
            rng: Draws the batches and the points of the gradient penalty.

        Returns:
            The mean `loss`, and the accuracies before the first step, `accuracy_expert` and
            `accuracy_learner`.
        """
        data = [self._encode(expert, log_probs[0]), self._encode(learner, log_probs[1])]
        with torch.no_grad():
            found = {
                "accuracy_expert": (self.logits(data[0]) > 0).float().mean().item(),
                "accuracy_learner": (self.logits(data[1]) < 0).float().mean().item(),
            }
        losses = [self._step(data, rng) for _ in range(self.config.steps)]
        return {"loss": float(np.mean(losses)), **found}

    def _step(self, data: Sequence[Batch], rng: np.random.Generator) -> float:
        expert, learner = (_drawn(one, self.config.batch_size, rng) for one in data)
        logits = torch.cat([self.logits(expert), self.logits(learner)])
        labels = torch.cat([torch.ones(len(expert[0])), torch.zeros(len(learner[0]))])
        loss = binary_cross_entropy_with_logits(logits, labels)
        total = loss
        if self.config.penalty:
            total = loss + self.config.penalty * self._gradient_penalty(expert, learner, rng)
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        self.optimizer.step()
        return loss.item()

    def _gradient_penalty(self, expert: Batch, learner: Batch, rng: np.random.Generator) -> Tensor:
        """Return the mean (|gradient of logit| - 1)^2 at random points between the batches
        (Gulrajani et al. 2017).
        """
        share = torch.from_numpy(rng.random((len(expert[0]), 1), dtype=np.float32))
        mixed = tuple(a * share + b * (1 - share) for a, b in zip(expert, learner, strict=True))
        inputs = [one.requires_grad_() for one in mixed[:3]]
        found = torch.autograd.grad(
            self.logits(mixed).sum(), inputs, create_graph=True, allow_unused=True
        )
        gradients = torch.cat([one for one in found if one is not None], dim=1)
        return (gradients.norm(dim=1) - 1.0).square().mean()

    def _encode(self, rows: Transitions, log_probs: F32) -> Batch:
        live = 1.0 - torch.from_numpy(rows.states[:, -1:])
        actions = torch.from_numpy(rows.actions) * self.free * live
        log_prob = torch.from_numpy(log_probs)[:, None]
        return self._state(rows.states), actions, self._state(rows.next_states), log_prob

    def _state(self, states: F32) -> Tensor:
        inputs, absorbing = torch.from_numpy(states).tensor_split([-1], dim=1)
        return torch.cat([self._normalise(inputs) * (1.0 - absorbing), absorbing], dim=1)


def _drawn(data: Batch, count: int, rng: np.random.Generator) -> Batch:
    rows = torch.from_numpy(rng.integers(len(data[0]), size=count))
    return tuple(column[rows] for column in data)
