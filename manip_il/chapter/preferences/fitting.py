"""Fit a reward to answers about pairs of clips, and measure how well it predicts held-out answers.

It is fitted with the Bradley-Terry model of preferences between clips, in folds: every pair is held
out from one of the networks.

    P(left is better) = (1 - E) sigmoid(R(left) - R(right)) + E / 2
    R(clip) = sum over its steps of r(s, a)

(Bradley & Terry 1952; Christiano et al. 2017, section 2.2.3, where E = 0.1 is the share of answers
that are random, whatever the clips.)
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from manip_il.chapter.preferences.pairs import Answers, Clips
from manip_il.chapter.reward import RewardNetwork, RewardShape
from manip_il.errors import ManipError
from manip_il.evaluation.intervals import Proportion
from manip_il.learn.batches import generator_of
from manip_il.learn.network import threads
from manip_il.mdp import F64, I64

BY_CHANCE = 0.1  # E, the share of random answers
_LR = 1e-4
_WEIGHT_DECAY = 1.0
_BATCH = 16
_EPOCHS, _PATIENCE = 200, 15
_ROWS = 8_192  # rows evaluated at a time


@dataclass(frozen=True, eq=False)
class FittedReward:
    """Networks fitted to answers, and their agreement on held-out pairs.

    Each network holds out some of the pairs.

    Attributes:
        network: The networks.
        logits: R(left) - R(right) of every answer, by the network that held it out, (A,).
        epochs: Number of epochs that the networks were trained for.
        answered: Agreement with the answers that are not `equal`.
    """

    network: RewardNetwork
    logits: F64
    epochs: int
    answered: Proportion

    def to_json(self) -> dict[str, Any]:
        """Return the content of `fit.json`."""
        right = {
            "rate": self.answered.rate,
            "interval": list(self.answered.interval),
            "right": self.answered.successes,
            "of": self.answered.n,
        }
        return {"agreement_with_answers": right, "epochs": self.epochs}


def fit_answers(
    clips: Clips,
    answers: Answers,
    shape: RewardShape,
    seed: int,
    on_epoch: Callable[[], None] = lambda: None,
) -> FittedReward:
    """Fit a reward and measure it on held-out pairs.

    The pairs are split into as many folds as there are networks: network m holds out fold m and
    trains on the others. All stop at the epoch with the lowest loss on the held-out folds. The same
    arguments give the same bits.

    Args:
        clips: The pairs and their frames.
        answers: Answers about the pairs.
        shape: Sizes of the networks.
        seed: Of the first weights, the folds and the order of the answers.
        on_epoch: Called after every epoch.

    Raises:
        ManipError: If fewer pairs have answers than there are networks.
    """
    folds = deal(answers.pair, shape.members, seed)
    inputs, sides = torch.from_numpy(clips.data.inputs), torch.from_numpy(clips.rows[answers.pair])
    with threads(1):
        network = RewardNetwork(inputs.shape[1], shape)
        network.initialise(generator_of(seed, 0))
        features = network.features(inputs)
        network.mean.copy_(features.mean(0))
        network.std.copy_(features.std(0).clamp(min=1e-6))
        epochs = _train(network, inputs, sides, answers.better, folds, seed, on_epoch)
        with torch.no_grad():
            every = network.logits(inputs, sides).numpy().astype(np.float64)
            logits = every[folds, np.arange(len(folds))]
            network.set_range(
                torch.cat([network.members(part).mean(0) for part in inputs.split(_ROWS)])
            )
    right = ((logits > 0) == (answers.better > 0.5))[answers.better != 0.5]
    answered = Proportion(int(right.sum()), max(len(right), 1))
    return FittedReward(network, logits, epochs, answered)


def summary_lines(found: FittedReward, answers: Answers) -> list[str]:
    """Return a summary of the answers and the fit as plain lines."""
    given = f"{len(answers.better):,} answers about {len(set(answers.pair.tolist())):,} pairs"
    return [
        f"{given}, {answers.skipped:,} skipped",
        f"agreement with answers on held-out pairs: {found.answered}",
    ]


def deal(pair: I64, folds: int, seed: int) -> I64:
    """Return the fold of every answer; all answers about a pair are in the same fold.

    Args:
        pair: Number of the pair that each answer is about, (A,).
        folds: Number of folds.
        seed: Seed of the order in which pairs are dealt to the folds.

    Returns:
        Numbers of the folds, 0 to `folds` - 1, (A,).

    Raises:
        ManipError: If fewer pairs than folds have an answer.
    """
    names, place = np.unique(pair, return_inverse=True)
    if len(names) < folds:
        raise ManipError(
            f"only {len(names)} pairs have an answer (left, right or equal); expected at least"
            f" {folds}"
        )
    order = np.random.default_rng([seed, 2]).permutation(len(names))
    return (order % folds)[place]


def answer_losses(logits: Tensor, better: Tensor) -> Tensor:
    """Return the negative log-likelihood of answers, (M, A), for logits (M, A) and targets
    `better` (A,).
    """
    p = (1 - BY_CHANCE) * torch.sigmoid(logits) + BY_CHANCE / 2
    return nn.functional.binary_cross_entropy(p, better.expand_as(p), reduction="none")


def _train(
    network: RewardNetwork,
    inputs: Tensor,
    sides: Tensor,
    preferred: F64,
    folds: I64,
    seed: int,
    on_epoch: Callable[[], None],
) -> int:
    """Train all networks at once.

    Restore the weights of the epoch with the lowest held-out loss and return its number.

    Each network is evaluated on the fold that it holds out, so the mean loss covers every answer
    once. All stop at the same epoch: a choice by a single fold of some 25 answers would be mostly
    noise.
    """
    left_out = torch.from_numpy(folds == np.arange(len(network.weights[0]))[:, None])
    learns = (~left_out).float()
    better = torch.from_numpy(preferred).float()
    optimizer = torch.optim.AdamW(network.parameters(), lr=_LR, weight_decay=_WEIGHT_DECAY)
    lowest, best = math.inf, 0
    kept = copy.deepcopy(network.state_dict())
    generator = generator_of(seed, 1)
    for epoch in range(1, _EPOCHS + 1):
        for rows in torch.randperm(len(better), generator=generator).split(_BATCH):
            losses = answer_losses(network.logits(inputs, sides[rows]), better[rows])
            optimizer.zero_grad(set_to_none=True)
            (
                (losses * learns[:, rows]).sum(1) / learns[:, rows].sum(1).clamp(min=1)
            ).sum().backward()
            optimizer.step()
        with torch.no_grad():
            losses = answer_losses(network.logits(inputs, sides), better)
        on_epoch()
        if (loss := losses[left_out].mean().item()) < lowest:
            lowest, best = loss, epoch
            kept = copy.deepcopy(network.state_dict())
        elif epoch - best >= _PATIENCE:
            break
    network.load_state_dict(kept)
    return best
