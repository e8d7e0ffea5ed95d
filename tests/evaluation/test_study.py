"""A study's tables, files and page say what its runs did: costs, success, the target, and against the baseline."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from manip_il.errors import ManipError, UnknownName
from manip_il.evaluation.comparison import Arm, Measured
from manip_il.evaluation.curve_charts import across, study_curve
from manip_il.evaluation.report_data import ArmCurve
from manip_il.evaluation.rounds import Rule, choose, curve_points, history
from manip_il.evaluation.study import Study, table_markdown
from manip_il.evaluation.study_report import StudyReport, arm_kinds, render_study

from .test_comparison import EASY, HARD, measured
from .test_report import Page
from .test_rounds import records

SLOW, FAST = (0.3, 0.5, 0.9, 0.8), (0.5, 0.9, 0.9, 1.0)


def member(name: str, seed: int, outcomes: list[bool], successes: tuple[float, ...], labels: int = 100) -> Measured:
    run = history(records(successes, labels), name)
    made = measured(outcomes, seed, f"runs/s/{name}/seed_{seed}")
    return replace(made, chosen=choose(Rule(), run, None, name), history=run, policy=Path("p"))


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
    cells = getattr(study, which)()
    return next(dict(zip(cells.columns, row, strict=True)) for row in cells.rows if row[0] == name)


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


def test_the_target_is_told_in_labels_episodes_and_time():
    assert list(row(STUDY, "dagger", "target_table").values()) == ["dagger", "200", "6", "20.0 s", "1.5"]
    assert list(row(STUDY, "cloning", "target_table").values()) == ["cloning", "300", "9", "30.0 s", ""]
    assert row(STUDY, "dart", "target_table")["labels of cloning / of this arm"] == "0.3"


def test_a_target_that_the_baseline_missed_gives_a_lower_bound():
    study = replace(STUDY, target=1.0)
    assert list(row(study, "dagger", "target_table").values())[1:] == ["400", "12", "40.0 s", "> 1.0"]
    assert row(study, "cloning", "target_table")["labels to 100 %"] == "> 400, > 400"
    assert list(row(study, "dart", "target_table").values())[-1] == "not reached"


def test_the_markdown_has_both_tables_and_the_facts():
    text = table_markdown(STUDY)
    assert text.count("|---|") == 2
    assert "| dagger | 400 | 12 | 40.0 s |" in text
    assert "- dagger is better than cloning by 30.0 points" in text
    assert "100 test episodes; training seeds 0, 1" in text


def test_study_json_holds_every_round_of_every_run():
    data = json.loads(json.dumps(STUDY.to_json(), allow_nan=False))
    runs = data["arms"]["dagger"]["training_seeds"]
    assert [run["seed"] for run in runs] == [0, 1]
    assert [one["validation_success"] for one in runs[0]["rounds"]] == list(FAST)
    assert runs[0]["first_at_target"]["labels"] == 200
    assert runs[0]["chosen"]["round"] == 3
    assert data["arms"]["cloning"]["against_baseline"] is None
    assert data["arms"]["dagger"]["against_baseline"]["difference"] == pytest.approx(0.3)


def test_what_is_no_study_is_refused():
    with pytest.raises(UnknownName, match="did you mean 'cloning'"):
        Study(arms(), "clonig", 0.9, Rule())
    with pytest.raises(ManipError, match="belongs to no run"):
        Study((Arm("a", (measured(HARD, 0),)),), "a", 0.9, Rule())


@pytest.mark.parametrize("seeds", [1, 2])
def test_the_page_reaches_nothing_outside_and_shows_three_curves(seeds: int):
    evil = '<script>alert("x")</script>'
    study = Study((*arms(seeds), replace(arms(seeds)[0], name=evil)), "cloning", 0.9, Rule())
    html = render_study(StudyReport("t", "manip-il study x.yaml", study, {"at": "end"}, {"mujoco": "3.11.0"}))
    page = Page(html)
    assert page.open == []
    assert not any(tag == "script" for tag, _ in page.tags)
    assert sum(attributes.get("class") == "curve" for _, attributes in page.tags) == 3
    assert sum(attributes.get("class") == "target-level" for _, attributes in page.tags) == 3
    for words in (
        "expert labels",
        "episodes",
        "wall-clock [s]",
        "target, 90.0 %",
        study.verdict,
        "dagger, training seed 0",
    ):
        assert words in page.text
    assert html == render_study(StudyReport("t", "manip-il study x.yaml", study, {"at": "end"}, {"mujoco": "3.11.0"}))


def test_thin_lines_are_the_seeds_and_marks_their_mean():
    curve = ArmCurve("dagger", tuple(curve_points(history(records(s), "x")) for s in (FAST, SLOW, FAST[:2])))
    page = Page(study_curve([(curve, "arm arm-0")], "labels"))
    classes = [attributes.get("class") for _, attributes in page.tags]
    assert classes.count("thin") == 3
    assert classes.count("mark") == 2  # rounds that every seed has
    assert classes.count("join") == 3 + 3 + 1 + 1
    assert "round 1, 200 labels: 76.7 % on average" in page.text


def test_the_baseline_is_grey_and_the_others_keep_their_colours():
    assert list(arm_kinds(STUDY).values()) == ["arm base", "arm arm-0", "arm arm-1"]


@pytest.mark.parametrize(
    ("longest", "unit", "words"), [(200.0, 1, "[s]"), (1_000.0, 60, "[min]"), (20_000.0, 3600, "[h]")]
)
def test_wall_clock_is_shown_in_a_unit_that_people_read(longest: float, unit: float, words: str):
    x = across("seconds", [longest / 2, longest])
    assert x.unit == unit
    assert x.words.endswith(words)
    assert 0 < x.percent(longest / 2) < x.percent(longest) < 100
