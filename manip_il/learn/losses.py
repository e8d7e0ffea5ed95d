"""Behaviour cloning as maximum likelihood: the losses, and the action that each yields.

fit(D) = argmin over policies of the mean over D of -log pi(a* | s): empirical risk minimisation
(imitation-learning chapter, Eqs. 8.2 to 8.4; the same reduction to supervised learning in
Ross, Gordon and Bagnell, AISTATS 2011, section 2). A head defines the family of distributions
pi(. | s). The likelihood is that of independent pairs (Eq. 8.2), which those of one episode are
not, as an action decides the next state. The network gives `params` (B, size) for B rows; targets
(B, n) are in normalised units.

Acting is deterministic: one action per state. `mse` and `l1` do not model the spread.
"""

import math
from typing import override

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

LOSSES = ("mse", "l1", "gaussian", "mixture", "categorical")

# With a deterministic expert the likelihood grows without bound as the deviation goes to zero. The
# floor, 2 % of a target's standard deviation in the data, keeps the gradients finite.
MIN_LOG_STD = -4.0
_REACH = 3.0  # half-width of a smeared target [standard deviations]
_LEAST_SIGMA = 0.1  # least smearing of a target [bins]
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class Head(nn.Module):
    """A family of action distributions.

    Attributes:
        n: Numbers in an action.
        size: Parameters per row, by default n.
    """

    def __init__(self, n: int, size: int | None = None) -> None:
        super().__init__()
        self.n, self.size = n, size or n

    def nll(self, params: Tensor, target: Tensor) -> Tensor:
        """Return the loss of each row, (B,), from params (B, size) and target (B, n)."""
        raise NotImplementedError

    def action(self, params: Tensor) -> Tensor:
        """Return the action of each row, (B, n): by default the parameters themselves."""
        return params


class MSEHead(Head):
    """Mean squared error: a Gaussian with unit variance, up to constants. Acts with its mean."""

    @override
    def nll(self, params: Tensor, target: Tensor) -> Tensor:
        return (params - target).square().mean(-1)


class L1Head(Head):
    """Mean absolute error: a Laplace distribution with unit scale, up to constants.

    Acts with its median.
    """

    @override
    def nll(self, params: Tensor, target: Tensor) -> Tensor:
        return (params - target).abs().mean(-1)


class GaussianHead(Head):
    """Diagonal Gaussian: the network gives the mean; one log-deviation per dimension is learnt.

    Acts with the mean.

    The deviation does not depend on the state. If it did, easy states would outweigh hard ones by
    orders of magnitude in the mean's gradient and the mean would underfit (Seitzer et al., On the
    pitfalls of heteroscedastic uncertainty estimation, ICLR 2022). In closed loop, that made
    nearly every episode fail.
    """

    def __init__(self, n: int) -> None:
        super().__init__(n)
        self.raw_log_std = nn.Parameter(torch.zeros(n))

    @override
    def nll(self, params: Tensor, target: Tensor) -> Tensor:
        return -_normal_log_prob(target, params, floored_log_std(self.raw_log_std)).sum(-1)


class MixtureHead(Head):
    """Mixture of `components` diagonal Gaussians (Bishop, Mixture density networks, 1994).

    Acts with the mean of the heaviest component: the mixture's own mean may lie between two ways
    around an obstacle, where no demonstration goes.

    Args:
        n: Numbers in an action.
        components: Number of Gaussians K.
    """

    def __init__(self, n: int, components: int) -> None:
        super().__init__(n, components * (1 + 2 * n))
        self.components = components

    def split(self, params: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log-weights (B, K), means (B, K, n), log-deviations (B, K, n)."""
        k, n = self.components, self.n
        logits, means, raw = params.split([k, k * n, k * n], -1)
        shape = (*params.shape[:-1], k, n)
        return logits.log_softmax(-1), means.reshape(shape), floored_log_std(raw.reshape(shape))

    @override
    def nll(self, params: Tensor, target: Tensor) -> Tensor:
        log_weights, means, log_std = self.split(params)
        log_prob = _normal_log_prob(target.unsqueeze(-2), means, log_std).sum(-1)
        return -(log_weights + log_prob).logsumexp(-1)

    @override
    def action(self, params: Tensor) -> Tensor:
        log_weights, means, _ = self.split(params)
        heaviest = log_weights.argmax(-1)[..., None, None]
        return means.gather(-2, heaviest.expand(*means.shape[:-2], 1, self.n)).squeeze(-2)


class CategoricalHead(Head):
    """Cross-entropy over `bins` equal bins from -1 to 1, the range of the data, for each dimension.

    A target is smeared over the bins by a Gaussian of `sigma` bins around it (HL-Gauss: Farebrother
    et al., Stop regressing, ICML 2024, section 3.1), so that neighbouring bins count as near. `pad`
    bins of the same width at either end hold what is smeared past the range; without them a target
    at the end of the range would be pulled inwards. The expectation over the bin centres is the
    target. With a sigma of 0 there is no padding, and nearly all of a target is in the nearest bin.

    Acts with the expectation over the likeliest bin and the max(1, `pad`) bins on either side of
    it: exact within a bin, unlike the argmax, and never between two separate modes, unlike the
    expectation over all bins.

    Args:
        n: Numbers in an action.
        bins: Bins per dimension, at least 2.
        sigma: Standard deviation of a smeared target [bins].
    """

    def __init__(self, n: int, bins: int, sigma: float) -> None:
        pad = math.ceil(_REACH * sigma)
        total = bins + 2 * pad
        super().__init__(n, n * total)
        self.bins, self.pad = bins, pad
        self.total = total
        self.sigma = max(sigma, _LEAST_SIGMA)

    @override
    def nll(self, params: Tensor, target: Tensor) -> Tensor:
        return -(self.smeared(target) * self._logits(params).log_softmax(-1)).sum((-2, -1))

    def smeared(self, target: Tensor) -> Tensor:
        """Return the share of each target (B, n) in each bin, (B, n, bins + 2 pad), under its
        Gaussian.
        """
        # targets, clamped to the data's range, in bins from the first centre
        place = (target.clamp(-1.0, 1.0) + 1.0) * (0.5 * (self.bins - 1)) + self.pad
        edges = torch.arange(self.total + 1, dtype=target.dtype, device=target.device) - 0.5
        below = torch.special.ndtr((edges - place.unsqueeze(-1)) / self.sigma)
        # The ends are at least 3 sigma from any target, so the sum is never 0.
        return below.diff(dim=-1) / (below[..., -1:] - below[..., :1])

    @override
    def action(self, params: Tensor) -> Tensor:
        logits, reach = self._logits(params), max(1, self.pad)
        near = logits.argmax(-1, keepdim=True) + torch.arange(
            -reach, reach + 1, device=params.device
        )
        inside = (near >= 0) & (near < self.total)
        near = near.clamp(0, self.total - 1)
        weights = logits.gather(-1, near).masked_fill(~inside, -torch.inf).softmax(-1)
        centres = (near.to(params.dtype) - self.pad) * (2.0 / (self.bins - 1)) - 1.0
        return (weights * centres).sum(-1)

    def _logits(self, params: Tensor) -> Tensor:
        return params.reshape(*params.shape[:-1], self.n, self.total)


def make_head(loss: str, n: int, *, components: int, bins: int, sigma: float) -> Head:
    """Return a new head.

    Args:
        loss: A name in `LOSSES`.
        n: Numbers in an action.
        components: Gaussians in `mixture`.
        bins: Bins per dimension in `categorical`.
        sigma: Standard deviation of a smeared target in `categorical` [bins].
    """
    if loss == "mixture":
        return MixtureHead(n, components)
    if loss == "categorical":
        return CategoricalHead(n, bins, sigma)
    return {"mse": MSEHead, "l1": L1Head, "gaussian": GaussianHead}[loss](n)


def floored_log_std(raw: Tensor) -> Tensor:
    """Return log-deviations of the shape of `raw`, (B, n), smoothly bounded below by
    `MIN_LOG_STD`.
    """
    return MIN_LOG_STD + softplus(raw - MIN_LOG_STD)


def _normal_log_prob(value: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    return -0.5 * ((value - mean) * torch.exp(-log_std)).square() - log_std - _HALF_LOG_2PI
