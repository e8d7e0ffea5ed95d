"""Which round a comparison takes follows from the rule and the validation alone."""

from typing import Any

import pytest

from manip_il.errors import ManipError, UsageError
from manip_il.evaluation.rounds import Rule, history, largest_dip

SUCCESS = (0.5, 0.9, 0.8, 0.9, 0.7)


def records(successes: tuple[float, ...] = SUCCESS, labels: int = 100, seconds: float = 10.0) -> list[dict[str, Any]]:
    return [
        {
            "round": i,
            "labels": labels * (i + 1),
            "queries": labels * (i + 1) + 5,
            "episodes": 3 * (i + 1),
            "validation_success": success,
            "validation_episodes": 10,
            "seconds": {"collect": seconds / 4, "fit": 3 * seconds / 4, "validate": 100.0},
        }
        for i, success in enumerate(successes)
    ]


RUN = history(records(), "runs/x")


def test_wall_clock_adds_up_without_validating():
    assert [one.seconds for one in RUN] == [10, 20, 30, 40, 50]
    assert RUN[-1].validating == 500
    assert (RUN[2].labels, RUN[2].queries, RUN[2].episodes) == (300, 305, 9)
    assert str(RUN[1].validation) == "90.0 % [59.6, 98.2]"


def test_the_order_of_the_lines_does_not_matter():
    assert history(records()[::-1], "x") == RUN


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([], "no finished round"),
        ([{"step": 100, "loss": 0.1}], "not written by a run of manip-il"),
        ([records()[0] | {"seconds": None}], "not written by a run of manip-il"),
    ],
)
def test_lines_that_are_no_runs_are_refused_by_name(lines, words):
    with pytest.raises(ManipError, match=words) as error:
        history(lines, "runs/x")
    assert "runs/x" in str(error.value)


def test_best_is_the_later_of_equals_and_last_is_last():
    assert Rule("best").select(RUN, None, "x").round == 3
    assert Rule("last").select(RUN, None, "x").round == 4


@pytest.mark.parametrize(
    ("at", "best", "last"), [("labels:450", 3, 3), ("labels:399", 1, 2), ("episodes:6", 1, 1), ("seconds:20", 1, 1)]
)
def test_rounds_count_up_to_the_amount(at: str, best: int, last: int):
    for checkpoint, expected in (("best", best), ("last", last)):
        rule = Rule.parse(checkpoint, at)
        assert rule.select(RUN, rule.limit({"x": RUN}), "x").round == expected


def test_without_an_amount_it_is_what_every_run_reached():
    shorter = history(records((0.1, 0.2, 0.3), labels=120, seconds=40), "y")
    both = {"x": RUN, "y": shorter}
    amounts = {at: Rule.parse("last", at).limit(both) for at in ("end", "labels", "episodes", "seconds")}
    assert amounts == {"end": None, "labels": 360, "episodes": 9, "seconds": 50}
    rule = Rule.parse("last", "seconds")
    assert [rule.select(run, 50, "x").round for run in (RUN, shorter)] == [4, 0]


def test_an_amount_that_no_round_is_within_or_not_every_run_reached_is_refused():
    rule = Rule.parse("best", "labels:99")
    with pytest.raises(UsageError, match=r"runs/x has no round within 99 labels; its first took 100 labels"):
        rule.select(RUN, rule.limit({"x": RUN}), "runs/x")
    with pytest.raises(UsageError, match="one ended at 500 labels"):
        Rule.parse("best", "labels:527").limit({"x": RUN})
    assert Rule.parse("best", "labels:526").limit({"x": RUN}) == 526  # rounds do not end on the dot


@pytest.mark.parametrize("at", ["end:5", "labels:", "labels:-1", "labels:nan", "seconds:many", "seconds:inf"])
def test_an_amount_that_is_none_is_refused(at: str):
    with pytest.raises(UsageError, match="labels:5000"):
        Rule.parse("best", at)


def test_an_unknown_way_is_answered_with_the_nearest():
    with pytest.raises(UsageError, match="did you mean 'labels'"):
        Rule.parse("best", "lables:3")


def test_a_dip_is_measured_from_the_best_before():
    assert largest_dip(RUN) == pytest.approx(0.2)
    assert largest_dip(RUN[:2]) == 0
    assert largest_dip(history(records((0.9, 0.1, 0.95)), "x")) == pytest.approx(0.8)
