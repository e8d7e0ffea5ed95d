"""Each loss is the likelihood it says it is, and only the right ones can hold two ways at once."""

import pytest
import torch
from torch import distributions as td

from manip_il.learn.losses import (
    LOSSES,
    CategoricalHead,
    GaussianHead,
    Head,
    MixtureHead,
    floored_log_std,
    make_head,
)

N = 3


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def head_for(loss: str, n: int = N, sigma: float = 1.0) -> Head:
    return make_head(loss, n, components=4, bins=11, sigma=sigma)


def fitted(
    head: Head, targets: torch.Tensor, steps: int = 600
) -> tuple[torch.Tensor, float, float]:
    """The best constant params for `targets` (B, n), and the loss before and after."""
    start = torch.randn(head.size, generator=torch.Generator().manual_seed(1))
    params = start.clone().requires_grad_()
    learned = list(head.parameters()) if isinstance(head, torch.nn.Module) else []
    optimizer = torch.optim.Adam([params, *learned], lr=0.05)
    losses = []
    for _ in range(steps):
        loss = head.nll(params.expand(len(targets), -1), targets).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return params.detach(), losses[0], losses[-1]


@pytest.mark.parametrize("loss", LOSSES)
def test_fitting_reduces_the_loss_and_acts_near_a_single_target(loss, generator):
    target = torch.tensor([0.3, -0.52, 0.71])
    targets = target + 0.01 * torch.randn((64, N), generator=generator)
    params, before, after = fitted(head_for(loss), targets)
    assert after < before
    torch.testing.assert_close(head_for(loss).action(params[None])[0], target, atol=0.02, rtol=0)


def torchs(head: Head, params: torch.Tensor) -> td.Distribution:
    """Torch's distribution of the same parameters.

    A categorical one is over the numbers of the bins.
    """
    if isinstance(head, GaussianHead):
        return td.Independent(td.Normal(params, floored_log_std(head.raw_log_std).exp()), 1)
    if isinstance(head, MixtureHead):
        log_weights, means, log_std = head.split(params)
        parts = td.Independent(td.Normal(means, log_std.exp()), 1)
        return td.MixtureSameFamily(td.Categorical(logits=log_weights), parts)
    assert isinstance(head, CategoricalHead)
    return td.Independent(td.Categorical(logits=params.reshape(-1, head.n, head.bins)), 1)


@pytest.mark.parametrize("loss", ["gaussian", "mixture", "categorical"])
def test_the_loss_is_torchs_negative_log_likelihood_with_a_gradient(loss, generator):
    head = head_for(loss, sigma=0.0)  # all of a target at a bin's centre is in that bin
    if isinstance(head, GaussianHead):
        torch.nn.init.normal_(head.raw_log_std, generator=generator)
    params, target = (
        3 * torch.randn((5, head.size), generator=generator),
        torch.randn((5, N), generator=generator),
    )
    bins = torch.tensor([0, 5, 10]).expand(5, N)
    ours, theirs = (bins / 5.0 - 1.0, bins) if loss == "categorical" else (target, target)
    losses = head.nll(params.requires_grad_(), ours)
    torch.testing.assert_close(-losses, torchs(head, params).log_prob(theirs))
    losses.sum().backward()
    assert params.grad is not None
    assert params.grad.abs().sum() > 0


SIGMAS = (0.3, 0.75, 2.0, 3.0)
TARGETS = torch.linspace(-1, 1, 41)[:, None]


@pytest.mark.parametrize("sigma", SIGMAS)
def test_a_smeared_target_sums_to_one_and_its_expectation_is_the_target(sigma: float):
    head = CategoricalHead(1, 21, sigma)
    shares = head.smeared(TARGETS.double())
    assert (shares >= 0).all()
    torch.testing.assert_close(shares.sum(-1), torch.ones(41, 1).double())
    centres = (torch.arange(head.total) - head.pad) * 0.1 - 1
    expected, width = (shares * centres).sum(-1), 0.1
    # up to the wave of bins narrower than the Gaussian resolves, and to what lies beyond 3
    # deviations
    torch.testing.assert_close(
        expected, TARGETS.double(), atol=width * (0.06 if sigma < 0.5 else 0.02), rtol=0
    )
    spread = (shares * (centres - expected.unsqueeze(-1)).square()).sum(-1).sqrt() / width
    if sigma >= 0.75:
        torch.testing.assert_close(
            spread, torch.full_like(spread, (sigma**2 + 1 / 12) ** 0.5), rtol=0.03, atol=0
        )


@pytest.mark.parametrize(
    ("loss", "on_a_mode"),
    [("mse", False), ("gaussian", False), ("mixture", True), ("categorical", True)],
)
def test_two_ways_are_kept_apart_by_mixture_and_categorical_alone(loss, on_a_mode, generator):
    signs = torch.where(torch.rand((256, 1), generator=generator) < 0.6, 1.0, -1.0)
    targets = signs * 0.6 + 0.02 * torch.randn((256, 1), generator=generator)
    params, *_ = fitted(head_for(loss, n=1), targets)
    action = head_for(loss, n=1).action(params[None]).item()
    if on_a_mode:
        assert action == pytest.approx(0.6, abs=0.05)
    else:
        assert abs(action) < 0.3
