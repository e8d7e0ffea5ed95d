"""A comparison is paired by training seed and by test episode, and says no more than its numbers
show.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.evaluation.comparison import Comparison, Study
from manip_il.evaluation.intervals import paired_interval
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings
from manip_il.evaluation.side import Member, Side, require_pair

from .made_evals import FIRST_SEED, made_side

SETTINGS = EvalSettings(100, 0.02)
EASY = [True] * 80 + [False] * 20
HARD = [True] * 50 + [False] * 50


def result(outcomes: list[bool], **changes: Any) -> EvalResult:
    episodes = tuple(
        EpisodeResult(FIRST_SEED + i, good, good, 10, 0.0) for i, good in enumerate(outcomes)
    )
    return replace(
        EvalResult("p", "panda", "reach", {"mujoco": "3.11.0"}, episodes, SETTINGS), **changes
    )


def side(name: str, *outcomes: list[bool], **changes: Any) -> Side:
    results = [result(one, **changes) for one in outcomes]
    return Side(
        name, tuple(Member(Path(name), seed, result=one) for seed, one in enumerate(results))
    )


def test_one_policy_against_another_is_the_paired_comparison():
    comparison = Comparison(side("A", HARD), side("B", EASY))
    assert comparison.difference == pytest.approx(0.3)
    assert comparison.interval == paired_interval([1] * 30 + [0] * 70)
    assert comparison.verdict.startswith("B is better than A by 30.0 points [20.")
    assert comparison.verdict.endswith("p < 0.001, 100 paired episodes.")


def test_the_verdict_names_the_better_one_on_either_side_and_no_small_difference():
    assert Comparison(side("A", EASY), side("B", HARD)).verdict.startswith(
        "A is better than B by 30.0 points [20."
    )
    verdict = Comparison(side("A", HARD), side("B", HARD[:-1] + [True])).verdict
    assert verdict.startswith("No difference shown between B and A: +1.0 points [")


def test_over_training_seeds_the_mean_difference_has_students_interval():
    better = Comparison(
        side("A", HARD, HARD, HARD), side("B", EASY, EASY[1:] + [True], EASY[:-1] + [False])
    )
    assert better.means == pytest.approx([0.3, 0.31 - 0.01, 0.3])
    assert better.significant
    assert "100 paired episodes on each of 3 training seeds, ahead in 3" in better.verdict


def test_these_policies_may_differ_where_training_seeds_do_not_show_it():
    comparison = Comparison(side("A", HARD, HARD), side("B", EASY, HARD[:-2] + [True, True]))
    low, high = comparison.interval
    assert comparison.p_value < 0.001
    assert low < 0 < high
    assert not comparison.significant
    assert comparison.verdict.startswith("No difference shown between B and A: +16.0 points [")


def test_random_arms_of_one_quality_are_seldom_called_different():
    """The level holds: of 400 comparisons of equals, about 5 % or fewer are called better."""
    rng = np.random.default_rng(0)
    difficulty = rng.uniform(0.2, 1.0, 40)  # episodes are hard or easy for everyone
    wrong = 0
    for _ in range(400):
        drawn = rng.random((2, 3, 40)) < difficulty
        wrong += Comparison(
            *(side(name, *one.tolist()) for name, one in zip("AB", drawn, strict=True))
        ).significant
    assert wrong <= 32  # 3 standard deviations above 5 %


def test_what_is_not_paired_is_refused():
    with pytest.raises(UsageError, match=r"training seeds differ: A has \[0, 1\], B \[0, 1, 2\]"):
        require_pair(side("A", HARD, HARD), side("B", HARD, HARD, HARD))
    with pytest.raises(ManipError, match=r"test episodes of A and B differ"):
        Study((side("A", HARD), side("B", HARD[:50])), "A")
    with pytest.raises(MismatchError, match=r"robot differs: A has panda, B has fetch"):
        Comparison(side("A", HARD), side("B", HARD, robot="fetch"))
    with pytest.raises(MismatchError, match=r"tolerance differs: A has 0\.02, B has 0\.05"):
        Comparison(side("A", HARD), side("B", HARD, settings=EvalSettings(100, 0.05)))


SLOW, FAST = (0.3, 0.5, 0.9, 0.8), (0.5, 0.9, 0.9, 1.0)
STUDY = Study(
    (
        made_side("cloning", [result(HARD)] * 2, SLOW),
        made_side("dagger", [result(EASY)] * 2, FAST),
        made_side("dart", [result(HARD[:-1] + [True])] * 2, SLOW, 300),
    ),
    "cloning",
    target=0.9,
)


def row(study: Study, name: str) -> dict[str, str]:
    table = study.table()
    return next(dict(zip(table.columns, row, strict=True)) for row in table.rows if row[0] == name)


def test_the_headline_names_the_best_or_which_of_two_is_better():
    rates = (
        "dagger solves 80.0 % of 100 unseen starts, the mean of 2 training seeds; dart 51.0 %,"
        " cloning 50.0 %."
    )
    assert STUDY.verdict == rates
    two = replace(STUDY, sides=STUDY.sides[:2])
    assert two.verdict == two.comparisons["dagger"].verdict


def test_a_row_holds_what_the_side_had_cost_and_how_it_did():
    assert row(STUDY, "dagger") == {
        "side": "dagger",
        "labels": "400",
        "episodes": "12",
        "seconds": "40",
        "validation": "100.0 % (100.0, 100.0)",
        "test": "80.0 % (80.0, 80.0)",
        "test, against cloning": "+30.0 points [+30.0, +30.0], p < 0.001",
        "labels to 90 %": "200",
    }
    assert row(STUDY, "cloning")["test, against cloning"] == ""


def test_compare_json_holds_every_round_and_what_the_verdict_rests_on():
    data = json.loads(json.dumps(STUDY.to_json(), allow_nan=False))
    dagger = data["arms"]["dagger"]
    runs, against = dagger["training_seeds"], dagger["against_baseline"]
    assert [run["seed"] for run in runs] == [0, 1]
    assert [one["validation_success"] for one in runs[0]["rounds"]] == list(FAST)
    assert (runs[0]["chosen"]["round"], runs[0]["first_at_target"]["labels"]) == (3, 200)
    assert data["arms"]["cloning"]["against_baseline"] is None
    assert against["difference"] == pytest.approx(0.3)
    assert (against["only_left"], against["only_right"], against["both"]) == (0, 60, 100)
    assert data["test_seeds"] == [4_000_000, 4_000_099]


def test_tasks_are_not_compared():
    study = replace(STUDY, baseline=None)
    assert study.verdict == STUDY.verdict
    assert study.comparisons == {}
    assert not any("against" in column for column in study.table().filled().columns)
