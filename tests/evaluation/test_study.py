"""A study's tables, files and page say what its runs did: costs, success, the target, and against the baseline."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from manip_il.evaluation.arm import Arm, Member
from manip_il.evaluation.rounds import Rule, history
from manip_il.evaluation.study import Study

from .test_comparison import EASY, HARD, made_member
from .test_rounds import records

SLOW, FAST = (0.3, 0.5, 0.9, 0.8), (0.5, 0.9, 0.9, 1.0)


def member(name: str, seed: int, outcomes: list[bool], successes: tuple[float, ...], labels: int = 100) -> Member:
    run = history(records(successes, labels), name)
    made = made_member(outcomes, seed, f"runs/s/{name}/seed_{seed}")
    return replace(made, chosen=Rule().select(run, None, name), history=run, policy=Path("p"))


def arms(seeds: int = 2) -> tuple[Arm, ...]:
    return tuple(
        Arm(name, tuple(member(name, seed, outcomes, successes, labels) for seed in range(seeds)))
        for name, outcomes, successes, labels in (
            ("cloning", HARD, SLOW, 100),
            ("dagger", EASY, FAST, 100),
            ("dart", HARD[:-1] + [True], SLOW, 300),
        )
    )


STUDY = Study(arms(), "cloning", 0.9, Rule())


def row(study: Study, name: str, which: str = "results_table") -> dict[str, str]:
    table = getattr(study, which)()
    return next(dict(zip(table.columns, row, strict=True)) for row in table.rows if row[0] == name)


def test_the_headline_names_the_best_and_the_baseline():
    assert STUDY.verdict == "dagger solves 80.0 % of 100 unseen starts, the mean of 2 training seeds; cloning 50.0 %."
    assert replace(STUDY, baseline="dagger").verdict.endswith("; dart 51.0 %.")


def test_a_row_holds_what_the_arm_had_cost_and_how_it_did():
    assert row(STUDY, "dagger") == {
        "arm": "dagger",
        "labels": "400",
        "episodes": "12",
        "wall-clock": "40.0 s",
        "validation": "100.0 % (100.0, 100.0)",
        "test": "80.0 % (80.0, 80.0)",
        "test, against cloning": "+30.0 points [+30.0, +30.0], p < 0.001",
        "largest dip [points]": "0.0",
    }
    assert row(STUDY, "cloning")["test, against cloning"] == ""
    assert row(STUDY, "cloning")["largest dip [points]"] == "10.0"


def test_the_target_is_told_in_every_cost_and_costs_within_amounts():
    assert list(row(STUDY, "dagger", "target_table").values()) == ["dagger", "200", "6", "20.0 s"]
    assert list(row(STUDY, "cloning", "target_table").values()) == ["cloning", "300", "9", "30.0 s"]
    assert row(replace(STUDY, target=1.0), "cloning", "target_table")["labels to 100 %"] == "not in 2 of 2 seeds"
    within = replace(STUDY, within=(Rule.parse("best", "labels:250"), Rule.parse("best", "labels:50")))
    assert row(within, "dagger", "within_table") == {
        "arm, validation": "dagger",
        "within 250 labels": "90.0 % (90.0, 90.0)",
        "within 50 labels": "",
    }


def test_study_json_holds_every_round_of_every_run():
    data = json.loads(json.dumps(STUDY.to_json(), allow_nan=False))
    runs = data["arms"]["dagger"]["training_seeds"]
    assert [run["seed"] for run in runs] == [0, 1]
    assert [one["validation_success"] for one in runs[0]["rounds"]] == list(FAST)
    assert runs[0]["first_at_target"]["labels"] == 200
    assert runs[0]["chosen"]["round"] == 3
    assert data["arms"]["cloning"]["against_baseline"] is None
    assert data["arms"]["dagger"]["against_baseline"]["difference"] == pytest.approx(0.3)


def test_tasks_are_not_compared_and_have_what_the_expert_solves_beside_them():
    tests = {"expert": STUDY.arms[1].members[0].test, "fetch": STUDY.arms[0].members[0].test}
    study = replace(STUDY, baseline=None, experts={"dagger": tests, "dart": {"fetch": tests["fetch"]}})
    worst = "1 of 3 solve 80 % of their unseen starts; the last, cloning, solves 50.0 %."
    assert replace(study, target=0.8).verdict == worst
    assert study.comparisons == {}
    assert {name: row(study, "dagger")[name] for name in tests} == {"expert": "80.0 %", "fetch": "50.0 %"}
    assert [row(study, "dart")[name] for name in tests] == ["", "50.0 %"]
    assert not any("against" in column for column in study.results_table().filled().columns)
    assert study.to_json()["arms"]["dagger"]["expert"]["fetch"]["n_episodes"] == 100
