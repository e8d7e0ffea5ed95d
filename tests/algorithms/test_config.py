"""What does not go together is refused in one line, before anything runs."""

import pytest

from manip_il.algorithms.config import RunConfig, plan_of
from manip_il.learn.fit_config import FitConfig

CNN = FitConfig({"type": "cnn"})
ACT = FitConfig({"type": "act", "chunk_size": 8, "n_action_steps": 4})
DIFFUSION = FitConfig({"type": "diffusion", "horizon": 16, "n_action_steps": 8})


def test_a_branch_is_as_long_as_the_policy_needs_for_a_whole_plan():
    assert [plan_of(fit) for fit in (FitConfig(), ACT, DIFFUSION)] == [(1, 0), (8, 0), (16, 7)]
    lengths = [
        RunConfig(fit=fit, label="branch").steps_of_branch for fit in (FitConfig(), ACT, DIFFUSION)
    ]
    assert lengths == [1, 8, 16 + 7]


@pytest.mark.parametrize(
    ("label", "expected"),
    [("per_state", "every"), ("takeover", "one"), ("branch", "probability:0.125")],
)
def test_every_label_mode_has_a_query_rule_of_its_own(label, expected: str):
    assert str(RunConfig(fit=ACT, label=label).query) == expected
