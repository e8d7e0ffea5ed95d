"""The Bradley-Terry model of preferences between clips, fitted with folds: every pair is held out by some networks.

    P(left is better) = (1 - E) sigmoid(R(left) - R(right)) + E / 2,    R(clip) = sum over its steps of r(s, a)

(Bradley & Terry 1952; Christiano et al. 2017, section 2.2.3, where E = 0.1: the share of answers that are given by
chance, whatever the clips.)
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from manip_il.errors import ManipError
from manip_il.learn.batches import generator_of
from manip_il.learn.network import threads
from manip_il.learn.reward import RewardNetwork, RewardShape

F32, F64, I64 = NDArray[np.float32], NDArray[np.float64], NDArray[np.int64]
BY_CHANCE = 0.1  # E
_LR, _WEIGHT_DECAY, _BATCH = 1e-4, 1.0, 16
_EPOCHS, _PATIENCE = 200, 15
_RANGE = (0.01, 0.99)  # quantiles of the frames' rewards that become 0 and 1


@dataclass(frozen=True, eq=False)
class Compared:
    """Answers about pairs of clips. left, right: rows of their steps, (A, L); better: of the left one, (A,), 0 to 1.

    pair: number of the pair that was asked about, (A,); answers about one pair are held out together.
    """

    left: I64
    right: I64
    better: F64
    pair: I64


@dataclass(frozen=True, eq=False)
class Fit:
    """Networks, and what the one that did not learn from a pair says of it.

    logits: R(left) - R(right) of every answer, (A,). epochs: that the networks were trained for.
    """

    network: RewardNetwork
    logits: F64
    epochs: int


def fit_reward(
    inputs: F32, compared: Compared, shape: RewardShape, seed: int, on_epoch: Callable[[], None] = lambda: None
) -> Fit:
    """Fit the networks to answers; inputs: of every frame, (N, d).

    The pairs are dealt into as many folds as there are networks: network m leaves fold m out and learns from the
    others. All stop at the epoch at which the loss on what they leave out is lowest. The same arguments give the same
    bits. Raises `ManipError` for fewer pairs than networks.
    """
    folds = deal(compared.pair, shape.members, seed)
    with threads(1):
        network = RewardNetwork(inputs.shape[1], shape)
        network.initialise(generator_of(seed, 0))
        every = torch.from_numpy(inputs)
        features = network.features(every)
        network.mean.copy_(features.mean(0))
        network.std.copy_(features.std(0).clamp(min=1e-6))
        epochs = _train(network, every, compared, folds, seed, on_epoch)
        with torch.no_grad():
            logits = _logits(network, every, compared, slice(None))
            rewards = torch.cat([network.members(part).mean(0) for part in every.split(8_192)])
            low, high = torch.quantile(rewards[:: max(1, len(rewards) // 100_000)], torch.tensor(_RANGE)).tolist()
        network.low.fill_(low)
        network.high.fill_(max(high, low + 1e-6))
    own = logits.numpy()[folds, np.arange(len(folds))]
    return Fit(network, own.astype(np.float64), epochs)


def deal(pair: I64, folds: int, seed: int) -> I64:
    """Return the fold of every answer, (A,); all answers about a pair are in one."""
    names, place = np.unique(pair, return_inverse=True)
    if len(names) < folds:
        raise ManipError(f"{len(names)} pairs are answered by left, right or equal; expected at least {folds}")
    order = np.random.default_rng([seed, 2]).permutation(len(names))
    return (order % folds)[place]


def _train(
    network: RewardNetwork, inputs: Tensor, compared: Compared, folds: I64, seed: int, on_epoch: Callable[[], None]
) -> int:
    """Train all networks at once, each on its own folds; return the epoch with the lowest loss, and go back to it.

    The loss by which it is chosen is that of every network on the fold that it leaves out, so of every answer once: one
    number for all networks, as a single fold of some 25 answers would choose by chance.
    """
    member = np.arange(len(network.weights[0]))[:, None]
    left_out = torch.from_numpy(folds == member)
    learns = (~left_out).float()
    better = torch.from_numpy(compared.better).float()
    optimizer = torch.optim.AdamW(network.parameters(), lr=_LR, weight_decay=_WEIGHT_DECAY)
    lowest, best = math.inf, 0
    kept = copy.deepcopy(network.state_dict())
    generator = generator_of(seed, 1)
    for epoch in range(1, _EPOCHS + 1):
        for rows in torch.randperm(len(better), generator=generator).split(_BATCH):
            losses = answer_losses(_logits(network, inputs, compared, rows.numpy()), better[rows])
            optimizer.zero_grad(set_to_none=True)
            ((losses * learns[:, rows]).sum(1) / learns[:, rows].sum(1).clamp(min=1)).sum().backward()
            optimizer.step()
        with torch.no_grad():
            losses = answer_losses(_logits(network, inputs, compared, slice(None)), better)
        on_epoch()
        if (loss := losses[left_out].mean().item()) < lowest:
            lowest, best = loss, epoch
            kept = copy.deepcopy(network.state_dict())
        elif epoch - best >= _PATIENCE:
            break
    network.load_state_dict(kept)
    return best


def answer_losses(logits: Tensor, better: Tensor) -> Tensor:
    """Return the negative log-likelihood of answers, (M, A): logits (M, A), better (A,)."""
    p = (1 - BY_CHANCE) * torch.sigmoid(logits) + BY_CHANCE / 2
    return nn.functional.binary_cross_entropy(p, better.expand_as(p), reduction="none")


def _logits(network: RewardNetwork, inputs: Tensor, compared: Compared, rows: NDArray[np.int64] | slice) -> Tensor:
    """R(left) - R(right) by every network, (M, A)."""
    both = [torch.from_numpy(side[rows]) for side in (compared.left, compared.right)]
    returns = [network.members(inputs[side.reshape(-1)]).view(-1, *side.shape).sum(-1) for side in both]
    return returns[0] - returns[1]
