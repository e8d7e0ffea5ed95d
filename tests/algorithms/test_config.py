"""What does not go together is refused in one line, before anything runs."""

from __future__ import annotations

import pytest

from manip_il.algorithms.config import BetaSchedule, RunConfig, check_labels, plan_of
from manip_il.collect.query import Query
from manip_il.errors import UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.sim.config import CameraConfig

FRONT = CameraConfig(("front",))
CNN = FitConfig({"type": "cnn"})
ACT = FitConfig({"type": "act", "chunk_size": 8, "n_action_steps": 4})
DIFFUSION = FitConfig({"type": "diffusion", "horizon": 16, "n_action_steps": 8})


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"label_budget": 0}, "label_budget is 0; expected at least 1"),
        ({"query_rule": Query("ensemble", 0.1)}, "ensemble is 1, query 'ensemble:0.1'"),
        ({"ensemble": 3}, "ensemble is 3, query 'every'"),
        ({"label": "takeover", "beta": BetaSchedule("linear", 3)}, "learner rolls in alone"),
        ({"rounds": -1}, "rounds is -1"),
        ({"rounds": 100}, "rounds is 100; expected 0 to 99"),
        ({"episodes_per_round": 0}, "episodes_per_round is 0"),
        ({"disturbed_share": 1.5}, "disturbed_share is 1.5"),
        ({"branch_steps": 0}, "branch_steps is 0"),
        ({"method": "daggr"}, "unknown method 'daggr' .did you mean 'dagger'"),
        ({"method": "cloning", "label": "branch"}, "the expert drive throughout"),
        ({"method": "dart", "query_rule": Query("one")}, "the expert drive throughout"),
        ({"method": "dart", "fit": CNN, "cameras": FRONT}, "not for images"),
        ({"fit": CNN}, "give --cameras=front,side,wrist"),
        ({"cameras": FRONT}, "the policy takes none"),
        ({"fit": ACT, "cameras": FRONT}, "the policy takes none"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options, says: str):
    with pytest.raises(UsageError, match=says):
        RunConfig(**options)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"fit": ACT, "query_rule": Query("one")}, "act learns from 8 in a row; use label=branch"),
        ({"fit": DIFFUSION, "label": "branch", "branch_steps": 4}, "diffusion leaves out the last 7 frames"),
    ],
)
def test_labels_that_the_policy_cannot_learn_from_are_refused(options, says: str):
    with pytest.raises(UsageError, match=says):
        check_labels(RunConfig(**options))


def test_a_branch_is_as_long_as_the_policy_needs_for_a_whole_plan():
    assert [plan_of(fit) for fit in (FitConfig(), ACT, DIFFUSION)] == [(1, 0), (8, 0), (16, 7)]
    lengths = [RunConfig(fit=fit, label="branch").steps_of_branch for fit in (FitConfig(), ACT, DIFFUSION)]
    assert lengths == [1, 8, 16 + 7]


@pytest.mark.parametrize(
    ("label", "expected"), [("per_state", "every"), ("takeover", "one"), ("branch", "probability:0.125")]
)
def test_every_label_mode_has_a_query_rule_of_its_own(label, expected: str):
    assert str(RunConfig(fit=ACT, label=label).query) == expected
