"""What does not go together is refused in one line, before anything runs."""

from __future__ import annotations

import pytest

from manip_il.algorithms.beta import BetaSchedule
from manip_il.algorithms.config import RunConfig, check_labels, check_sight
from manip_il.engine.drivers import QueryRule
from manip_il.errors import UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.sim.look import CameraConfig

ACT = FitConfig({"type": "act", "chunk_size": 8, "n_action_steps": 4})
DIFFUSION = FitConfig({"type": "diffusion", "horizon": 16, "n_action_steps": 8})


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"label_budget": 0}, "label_budget is 0; expected at least 1"),
        ({"query_rule": QueryRule("ensemble", 0.1)}, "there is one policy; give ensemble=2"),
        ({"ensemble": 3}, "no query uses it"),
        ({"label": "takeover", "beta": BetaSchedule("linear", 3)}, "learner rolls in alone"),
        ({"label": "takeover", "query_rule": QueryRule("every")}, "from the first step on"),
        ({"method": "cloning", "label": "branch"}, "the expert drive throughout"),
        ({"method": "dart", "query_rule": QueryRule("one")}, "the expert drive throughout"),
        ({"refit_steps": 100}, "refit_steps is for refit=warm"),
        ({"branch_steps": 0}, "branch_steps is 0"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options, says: str):
    with pytest.raises(UsageError, match=says):
        RunConfig(**options)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (
            {"fit": ACT, "query_rule": QueryRule("one")},
            "act learns from 8 in a row; use label=branch",
        ),
        ({"fit": DIFFUSION, "label": "branch", "branch_steps": 4}, "diffusion leaves out the last 7 frames"),
        ({"query_rule": QueryRule("likelihood", -2)}, "--policy.type=mlp with --policy.loss=mixture or categorical"),
        ({"fit": FitConfig({"loss": "gaussian"}), "query_rule": QueryRule("likelihood", -2)}, "mixture or categorical"),
        ({"fit": ACT, "label": "branch", "query_rule": QueryRule("likelihood", -2)}, "--policy.type=mlp"),
    ],
)
def test_labels_that_the_policy_cannot_use_are_refused(options, says: str):
    with pytest.raises(UsageError, match=says):
        check_labels(RunConfig(**options))


@pytest.mark.parametrize(
    ("fit", "cameras", "method", "says"),
    [
        (FitConfig({"type": "cnn"}), (), "dagger", "give --cameras=front,wrist"),
        (FitConfig(), ("front",), "dagger", "the policy takes none"),
        (ACT, ("front",), "dagger", "the policy takes none"),
        (FitConfig({"type": "cnn"}), ("front",), "dart", "not for a policy on images"),
    ],
)
def test_what_is_pictured_is_what_is_looked_at(fit, cameras, method, says: str):
    config = RunConfig(fit=fit, method=method, cameras=CameraConfig(cameras) if cameras else None)
    with pytest.raises(UsageError, match=says):
        check_sight(config)


def test_an_mlp_that_is_to_see_is_refused_where_it_is_configured():
    with pytest.raises(UsageError, match="mlp does not take images"):
        FitConfig(observation="images")


def test_a_branch_is_as_long_as_the_policy_needs_for_a_whole_plan():
    assert [fit.plan_length for fit in (FitConfig(), ACT, DIFFUSION)] == [1, 8, 16]
    lengths = [RunConfig(fit=fit, label="branch").steps_of_branch for fit in (FitConfig(), ACT, DIFFUSION)]
    assert lengths == [1, 8, 16 + 7]


@pytest.mark.parametrize(
    ("label", "expected"), [("per_state", "every"), ("takeover", "one"), ("branch", "probability:0.125")]
)
def test_every_label_mode_has_a_query_rule_of_its_own(label, expected: str):
    assert str(RunConfig(fit=ACT, label=label).query) == expected
