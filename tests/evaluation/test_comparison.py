"""A comparison is paired by training seed and by test episode, and says no more than its numbers show."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.evaluation.arm import Arm, Member
from manip_il.evaluation.compare_report import comparison_table
from manip_il.evaluation.comparison import Comparison
from manip_il.evaluation.intervals import compare_paired
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings, write_json
from manip_il.evaluation.rounds import history

from .test_rounds import records

SETTINGS = EvalSettings(100, 0.02)
EASY = [True] * 80 + [False] * 20
HARD = [True] * 50 + [False] * 50


def made_member(outcomes: list[bool], seed: int | None = None, name: str = "p", **changes) -> Member:
    episodes = tuple(EpisodeResult(4_000_000 + i, good, good, 10, 0.0) for i, good in enumerate(outcomes))
    result = EvalResult(name, "panda", "reach", {"mujoco": "3.11.0"}, episodes, SETTINGS)
    return Member(Path(name), seed, result=replace(result, **changes), file=Path("e.json"))


def arm(name: str, *outcomes: list[bool]) -> Arm:
    return Arm(name, tuple(made_member(one, seed, f"{name}/seed_{seed}") for seed, one in enumerate(outcomes)))


def one(name: str, outcomes: list[bool]) -> Arm:
    return Arm(name, (made_member(outcomes, None, name),))


def test_one_policy_against_another_is_the_paired_comparison():
    comparison, paired = Comparison(one("A", HARD), one("B", EASY)), compare_paired(HARD, EASY)
    assert comparison.difference == pytest.approx(0.3)
    assert comparison.interval == paired.interval
    assert comparison.p_value == pytest.approx(paired.p_value, rel=1e-12)
    assert comparison.verdict.startswith("B is better than A by 30.0 points [20.")
    assert comparison.verdict.endswith("p < 0.001, 100 paired episodes.")


def test_the_verdict_names_the_better_one_on_either_side_and_no_small_difference():
    assert Comparison(one("A", EASY), one("B", HARD)).verdict.startswith("A is better than B by 30.0 points [20.")
    verdict = Comparison(one("A", HARD), one("B", HARD[:-1] + [True])).verdict
    assert verdict.startswith("No difference shown between B and A: +1.0 points [")


def test_over_training_seeds_the_mean_difference_has_students_interval():
    better = Comparison(arm("A", HARD, HARD, HARD), arm("B", EASY, EASY[1:] + [True], EASY[:-1] + [False]))
    assert [pair.difference for pair in better.pairs] == pytest.approx([0.3, 0.31 - 0.01, 0.3])
    assert better.significant
    assert "on average over 3 training seeds (ahead in 3 of 3)" in better.verdict
    assert "100 paired episodes on each of 3 training seeds" in better.verdict


def test_these_policies_may_differ_where_training_seeds_do_not_show_it():
    comparison = Comparison(arm("A", HARD, HARD), arm("B", EASY, HARD[:-2] + [True, True]))
    low, high = comparison.interval
    assert comparison.p_value < 0.001
    assert low < 0 < high
    assert not comparison.significant
    assert comparison.verdict.startswith("These policies of B are better than those of A (p < 0.001")
    assert "do not show that others would be: 16.0 points" in comparison.verdict


def test_two_equal_differences_alone_are_no_proof():
    """Student's interval has no width then; the episodes still have to show it."""
    comparison = Comparison(arm("A", HARD, HARD), arm("B", HARD[:-1] + [True], HARD[:-1] + [True]))
    assert comparison.interval == (0.01, 0.01)
    assert comparison.p_value == 1
    assert not comparison.significant


def test_equal_arms_are_not_called_different():
    comparison = Comparison(arm("A", HARD, EASY), arm("B", HARD, EASY))
    assert (comparison.difference, comparison.p_value) == (0, 1)
    assert "No difference shown between B and A: +0.0 points" in comparison.verdict


def test_random_arms_of_one_quality_are_seldom_called_different():
    """The level holds: of 400 comparisons of equals, about 5 % or fewer are called better."""
    rng = np.random.default_rng(0)
    difficulty = rng.uniform(0.2, 1.0, 40)  # episodes are hard or easy for everyone
    wrong = 0
    for _ in range(400):
        drawn = rng.random((2, 3, 40)) < difficulty
        wrong += Comparison(*(arm(name, *side.tolist()) for name, side in zip("AB", drawn, strict=True))).significant
    assert wrong <= 32  # 3 standard deviations above 5 %


def test_what_is_not_paired_is_refused():
    with pytest.raises(UsageError, match=r"training seeds differ: A has \[0, 1\], B \[0, 1, 2\]"):
        Comparison(arm("A", HARD, HARD), arm("B", HARD, HARD, HARD))
    with pytest.raises(ManipError, match=r"test episodes differ: A has 100, B 50, of which 50 are the same"):
        Comparison(one("A", HARD), one("B", HARD[:50]))
    with pytest.raises(MismatchError, match=r"robot differs: A has panda, B has fetch"):
        Comparison(one("A", HARD), Arm("B", (made_member(HARD, robot="fetch"),)))
    with pytest.raises(MismatchError, match=r"tolerance differs: A has 0\.02, B has 0\.05"):
        Comparison(one("A", HARD), Arm("B", (made_member(HARD, settings=EvalSettings(100, 0.05)),)))


def test_compare_json_holds_what_the_verdict_rests_on(tmp_path: Path):
    comparison = Comparison(arm("A", HARD, HARD), arm("B", EASY, EASY[:-1] + [True]))
    write_json(tmp_path / "new" / "compare.json", comparison.file_json())
    data = json.loads((tmp_path / "new" / "compare.json").read_text())
    assert data["difference"] == pytest.approx(0.305)
    assert data["interval"] == pytest.approx(list(comparison.interval))
    assert (data["only_left"], data["only_right"]) == (0, 61)
    assert data["test_seeds"] == [4_000_000, 4_000_099]
    first = data["training_seeds"][0]
    assert (first["left_seed"], first["both"], first["only_right"]) == (0, 50, 30)
    assert first["left"]["success_rate"] == 0.5


def test_the_table_says_what_the_chosen_round_had_cost():
    run = history(records(), "x")
    chosen = replace(made_member(EASY, 0, "B/seed_0"), chosen=run[2], history=run)
    table = comparison_table(Comparison(arm("A", HARD), Arm("B", (chosen,))))
    assert table.rows[1][:6] == ("B", "300", "9", "30.0 s", "80.0 % [49.0, 94.3]", "80.0 % [71.1, 86.7]")
    assert table.rows[1][6].startswith("+30.0 points [")
    assert table.rows[0][1:5] == ("",) * 4
