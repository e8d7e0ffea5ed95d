"""Batches for the network: the order of the samples, and pictures as floats.

While training, pictures can be cropped and recoloured at random.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from manip_il.mdp import F64, I64

_AT_ONCE = 16  # pictures processed at a time, so that intermediate results stay in the cache
_GREY = (0.299, 0.587, 0.114)  # weights of red, green and blue: ITU-R BT.601


def generator_of(*key: int) -> torch.Generator:
    """Return a CPU generator whose draws depend only on the key."""
    return torch.Generator().manual_seed(
        int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0] >> 1)
    )


class Order:
    """Row numbers in batches: a new shuffle of all rows every epoch, or draws in proportion to
    weights.

    A batch depends only on the seed and the step, so there is no state to save.

    Args:
        rows: The number of rows N.
        weights: One weight per row, (N,), to draw with replacement; None for epochs.
        batch_size: The number of rows in a batch.
        seed: Decides all shuffles and draws.
    """

    def __init__(self, rows: int, weights: F64 | None, batch_size: int, seed: int) -> None:
        self.rows = rows
        self.batch_size = batch_size
        self.seed = seed
        self._edges = None if weights is None else np.cumsum(weights) / weights.sum()
        self._epoch, self._order = -1, np.empty(0, np.int64)

    def batch(self, step: int) -> I64:
        """Return the row numbers of the batch at `step`, (batch_size,)."""
        if self._edges is not None:
            draws = np.random.default_rng([self.seed, step]).uniform(size=self.batch_size)
            return np.minimum(np.searchsorted(self._edges, draws, side="right"), self.rows - 1)
        drawn = np.arange(self.batch_size) + step * self.batch_size
        epochs, places = np.divmod(drawn, self.rows)
        return np.concatenate(
            [self._permutation(int(one))[places[epochs == one]] for one in np.unique(epochs)]
        )

    def _permutation(self, epoch: int) -> I64:
        if epoch != self._epoch:
            order = torch.randperm(self.rows, generator=generator_of(self.seed, epoch))
            self._epoch, self._order = epoch, order.numpy()
        return self._order


def to_float(pictures: Tensor) -> Tensor:
    """Return pixel values 0 to 255 (B, ...) as float32 in [0, 1], equal to those of LeRobot's
    loader.
    """
    return pictures.to(torch.float32).div_(255)


@dataclass(frozen=True)
class Augment:
    """Random crops and colour jitter.

    The factors are as in torchvision's `ColorJitter`, but are applied in a fixed order (saturation,
    contrast, brightness) with one clamp at the end.

    Attributes:
        shift: Largest shift of a crop in each direction [pixels]; the border repeats the outermost
            pixels (DrQ, Kostrikov et al. 2020, arXiv:2004.13649).
        brightness: Largest deviation of the factor of brightness from 1.
        contrast: Largest deviation of the factor of contrast from 1.
        saturation: Largest deviation of the factor of saturation from 1.
    """

    shift: int = 4
    brightness: float = 0.2
    contrast: float = 0.2
    saturation: float = 0.2

    def __call__(self, pictures: Tensor, generator: torch.Generator) -> Tensor:
        """Return the pictures, cropped and recoloured at random, as float32 in [0, 1].

        Crop and colours are drawn once per sample, the same for all T.

        Args:
            pictures: Pictures uint8 (B, 3, H, W) or (B, T, 3, H, W), on any device.
            generator: A generator on the CPU.

        Returns:
            Pictures of the same shape.
        """
        flat = pictures.flatten(0, -4)
        changed = torch.empty(flat.shape, dtype=torch.float32, device=flat.device)
        moves = torch.randint(0, 2 * self.shift + 1, (len(pictures), 2), generator=generator)
        amounts = torch.tensor([self.saturation, self.contrast, self.brightness])
        factors = 1 + amounts * (2 * torch.rand(len(pictures), 3, generator=generator) - 1)
        times = math.prod(pictures.shape[1:-3])
        drawn = (
            moves.repeat_interleave(times, 0),
            factors.repeat_interleave(times, 0).to(flat.device),
        )
        parts = (each.split(_AT_ONCE) for each in (changed, flat, *drawn))
        for target, source, move, factor in zip(*parts, strict=True):
            _crop(source, move, self.shift, target)
            _jitter(target, factor)
        return changed.view(pictures.shape)


def _crop(pictures: Tensor, moves: Tensor, shift: int, target: Tensor) -> None:
    """Crop pictures (B, 3, H, W), padded by `shift` pixels, starting at row and column `moves`
    (B, 2).
    """
    height, width = pictures.shape[-2:]
    padded = functional.pad(pictures.float(), (shift,) * 4, mode="replicate")
    for one, source, (y, x) in zip(target, padded, moves.tolist(), strict=True):
        one.copy_(source[:, y : y + height, x : x + width])


def _jitter(values: Tensor, factors: Tensor) -> None:
    """Jitter pictures (B, 3, H, W) in place; values 0 to 255 become 0 to 1.

    factors: saturation, contrast, brightness, (B, 3). Saturation blends with the grey picture,
    contrast with its mean, brightness with black. The sum is `own * picture + shared * grey +
    level`, which needs no matrix product, whose precision torch may lower.
    """
    saturation, contrast, brightness = factors.view(-1, 3, 1, 1).unbind(1)
    grey = values[:, 0] * _GREY[0]
    grey.add_(values[:, 1], alpha=_GREY[1]).add_(values[:, 2], alpha=_GREY[2])
    level = (1 - contrast) * brightness / 255 * grey.mean((1, 2), keepdim=True)
    grey.mul_((1 - saturation) * contrast * brightness / 255).add_(level)
    own = saturation * contrast * brightness / 255
    values.mul_(own[:, None]).add_(grey[:, None]).clamp_(0, 1)
