"""Statistics of the training data: what the network's units are."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# [rad] or [m]. An input that moves less than this in all of the data is noise that division by its
# deviation would blow up: it is multiplied by zero instead, so the network never sees it.
CONSTANT_INPUT = 1e-4
CONSTANT_TARGET = 1e-6


@dataclass(frozen=True)
class Statistics:
    """Float32 vectors over inputs (d,) and targets (n,), in raw units ([rad], [m]).

    x = (input - input_mean) * input_scale; target = target_mean + target_scale * y, clamped to
    [target_low, target_high], the range of the data.
    """

    input_mean: Tensor
    input_scale: Tensor
    target_mean: Tensor
    target_scale: Tensor
    target_low: Tensor
    target_high: Tensor

    def items(self) -> list[tuple[str, Tensor]]:
        """Name and tensor of each."""
        return [(field.name, getattr(self, field.name)) for field in fields(self)]


def identity_statistics(inputs: int, targets: int) -> Statistics:
    """Return statistics that change nothing."""
    everything = torch.full((targets,), torch.inf)
    zeros, ones = torch.zeros, torch.ones
    return Statistics(zeros(inputs), ones(inputs), zeros(targets), ones(targets), -everything, everything)


def fit_statistics(inputs: NDArray[np.float32], targets: NDArray[np.float32], loss: str) -> Statistics:
    """Return statistics of inputs (N, d) and targets (N, n).

    Targets are scaled by mean and deviation, for `categorical` by the middle and half-width of
    their range, which puts them in [-1, 1]. A constant target has scale 0: it is its mean.
    """
    low, high = targets.min(0).astype(np.float64), targets.max(0).astype(np.float64)
    if loss == "categorical":
        target_mean, target_scale = (low + high) / 2, (high - low) / 2
    else:
        target_mean, target_scale = targets.mean(0, dtype=np.float64), targets.std(0, dtype=np.float64)
    target_scale = np.where(target_scale < CONSTANT_TARGET, 0.0, target_scale)
    deviation = inputs.std(0, dtype=np.float64)
    input_scale = np.where(deviation < CONSTANT_INPUT, 0.0, 1.0 / np.maximum(deviation, CONSTANT_INPUT))
    values = (inputs.mean(0, dtype=np.float64), input_scale, target_mean, target_scale, low, high)
    return Statistics(*(torch.from_numpy(value.astype(np.float32)) for value in values))


def scale_targets(targets: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    """Return targets (B, n) in the network's units; 0 where the scale is 0."""
    inverse = torch.where(scale > 0, 1.0 / scale, torch.zeros_like(scale))
    return (targets - mean) * inverse
