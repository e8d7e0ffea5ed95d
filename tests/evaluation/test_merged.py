"""Parts of one evaluation are one again; what does not belong together is refused by name."""

from __future__ import annotations

from dataclasses import replace

import pytest

from manip_il.errors import ManipError, MismatchError
from manip_il.evaluation.episodes import EpisodeResult, EvalSettings
from manip_il.evaluation.results import EvalResult, merge_results
from manip_il.sim.conditions import Condition


def part(first: int, outcomes: list[bool], **changes) -> EvalResult:
    episodes = tuple(EpisodeResult(first + i, good, good, 10, 0.0) for i, good in enumerate(outcomes))
    whole = EvalResult(
        "runs/x", "panda", "reach", {"mujoco": "3"}, episodes, EvalSettings(100, 0.02), policy_sha256="ab"
    )
    return replace(whole, **changes)


def test_parts_in_any_order_are_the_whole():
    outcomes = [True, False, True, True, False, True]
    whole = part(10, outcomes)
    parts = {"c": part(14, outcomes[4:]), "a": part(10, outcomes[:3]), "b": part(13, outcomes[3:4])}
    merged = merge_results(parts)
    assert merged == whole
    assert (merged.success.successes, merged.success.n) == (4, 6)


def test_a_policy_is_the_same_wherever_it_lay():
    assert merge_results({"a": part(0, [True]), "b": part(1, [True], policy="/policy/x")}).success.n == 2
    without_files = {
        name: part(i, [True], policy=name, policy_sha256="") for i, name in enumerate(["expert", "random"])
    }
    with pytest.raises(MismatchError, match="policy differs"):
        merge_results(without_files)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"policy_sha256": "cd"}, "policy_sha256"),
        ({"robot": "fetch"}, "robot"),
        ({"task": "lift"}, "task"),
        ({"settings": EvalSettings(100, 0.05)}, "settings"),
        ({"settings": EvalSettings(100, 0.02, conditions=(Condition("k", mass=(0.1, 0.2)),))}, "settings"),
    ],
)
def test_what_differs_is_named_with_both_sides(changes, what):
    with pytest.raises(MismatchError, match=f"{what} differs: a has .*, b has"):
        merge_results({"a": part(0, [True]), "b": part(1, [True], **changes)})


def test_a_seed_that_two_parts_ran_is_named_with_both():
    with pytest.raises(ManipError, match="seed 2 is in a and in b"):
        merge_results({"a": part(0, [True] * 3), "b": part(2, [True])})


def test_a_part_that_stopped_by_what_it_saw_is_refused():
    with pytest.raises(ManipError, match="b stopped by --until_width"):
        merge_results({"a": part(0, [True]), "b": part(1, [True], until_width=0.1)})


def test_nothing_is_not_an_evaluation():
    with pytest.raises(ManipError, match="no evaluations"):
        merge_results({})
