"""The page of an evaluation says first how good, then where it fails; and no less where nothing or everything does."""

import re
from dataclasses import replace

import pytest

from manip_il.evaluation.episodes import EvalSettings
from manip_il.evaluation.eval_report import eval_report
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.report_data import CurvePoint, Film, LearningCurve, Paths
from manip_il.sim.conditions import Condition

from .made_evals import made_eval, without_detail
from .page import EVIL, Page, page_of
from .test_report import HAND, MP4

COMMAND = "manip-il eval --policy.path=runs/a/best --suite=all"
CURVE = LearningCurve((CurvePoint(400, Proportion(30, 50), "round 0"), CurvePoint(900, Proportion(45, 50), "round 1")))
FILMS = tuple(Film("policy", MP4, f"seed {seed}", success) for seed, success in ((5, True), (3, False), (4, False)))
REPORT = eval_report(made_eval(), COMMAND, {"eval": {"n_episodes": 120}}, FILMS, curve=CURVE)


@pytest.fixture(scope="module")
def page() -> Page:
    return page_of(REPORT)


def test_the_verdict_has_success_and_the_main_phase():
    result = REPORT.result
    failed = 120 - result.success.successes
    phase, count = next(iter(result.failures.items()))
    assert REPORT.verdict.startswith(
        f"runs/a/best succeeds in {result.success} of 120 unseen episodes of panda pick_place; "
        f"{count} of its {failed} failures end in the phase {phase}"
    )


def test_the_parts_stand_in_the_order_of_what_one_asks():
    assert re.findall(r"<h2>(.*?)</h2>", REPORT.render()) == [
        "Results",
        "Success against labels",
        "Where it fails",
        "What failures are associated with",
        "How it looks",
        "How it was made",
    ]


def test_every_condition_has_its_row_and_its_bar(page: Page):
    result = REPORT.result
    bars = page.bar_widths("(dagger|baseline)")
    parts = [
        [e.success for e in result.episodes if e.detail["condition"] == name]
        for name in ("nominal", "knocked", "sensing")
    ]
    assert bars == [f"{100 * sum(one) / len(one):.2f}%" for one in ([e.success for e in result.episodes], *parts)]
    for part in parts:
        assert str(Proportion.of(part)) in page.text


def test_a_single_condition_is_one_bar():
    html = eval_report(made_eval(conditions=("nominal",)), COMMAND).render()
    assert len(re.findall(r'class="bar dagger"', html)) == 1
    assert "all conditions" not in html


def test_what_failures_depend_on_is_marked_by_a_sign(page: Page):
    assert re.search(r"start of the object, x \[m\] [^▼]*▼ \d+\.\d % \[", page.text)
    assert "corrected (Holm)" in page.text


def test_failures_are_shown_before_successes_and_none_is_lost(page: Page):
    text = page.text
    places = [text.index(word) for word in ("Failures policy", "· seed 3", "· seed 4", "Successes policy", "· seed 5")]
    assert places == sorted(places)
    assert sum(tag == "video" for tag, _ in page.tags) == 3


def test_where_nothing_failed_the_page_says_so():
    report = eval_report(made_eval(fails=lambda *_: False), COMMAND)
    page = page_of(report)
    assert report.verdict == (
        f"runs/a/best succeeds in all 120 unseen episodes of panda pick_place: {report.result.success}."
    )
    assert "No failure in 120 episodes." in page.text
    assert "phase that they ended in" not in page.text
    assert "What failures are associated with" not in page.text


def test_where_everything_failed_the_page_says_so():
    report = eval_report(made_eval(fails=lambda *_: True), COMMAND)
    page = page_of(report)
    assert report.verdict.startswith("runs/a/best fails in all 120 unseen episodes of panda pick_place: 0.0 % [")
    assert "of its 120 failures end in the phase descend" in report.verdict
    assert "120 failed and 0 solved" in page.text
    assert "What failures are associated with" not in page.text


def test_the_hardest_condition_is_named_only_where_it_is_harder():
    by_chance = eval_report(made_eval(fails=lambda number, _: number % 10 == 0), COMMAND)
    assert "hardest" not in by_chance.verdict
    assert "No condition of the 3 is shown to be harder" in page_of(by_chance).text
    knocked = made_eval(fails=lambda number, detail: detail["condition"] == "knocked" and number % 2 == 0)
    assert eval_report(knocked, COMMAND).verdict.endswith("knocked is its hardest condition, with 50.0 %.")


def test_a_file_with_success_alone_still_has_its_page():
    page = page_of(eval_report(without_detail(made_eval()), COMMAND))
    assert "What failures are associated with" not in page.text
    assert "seen from above" not in page.text
    assert "not recorded" in page.text


def test_where_there_are_no_films_paths_are_grouped_alike():
    paths = tuple(Paths("p", HAND, HAND, HAND[-1], caption=f"seed {i}", success=i > 0) for i in range(2))
    page = page_of(replace(REPORT, films=(), paths=paths, pictures_note="no OpenGL here"))
    places = [page.text.index(word) for word in ("no OpenGL here", "Failures p", "seed 0", "Successes p", "seed 1")]
    assert places == sorted(places)


def test_the_page_has_what_conditions_draw():
    settings = EvalSettings(100, 0.02, suite="all", conditions=(Condition(), Condition("knocked", knock=(0.05, 0.08))))
    text = page_of(eval_report(replace(made_eval(), settings=settings), COMMAND)).text
    assert "What the conditions draw nominal nothing knocked knock 0.05 to 0.08, knock_step 5 to 24" in text


def test_an_evaluation_that_stopped_when_it_was_sure_says_so():
    text = page_of(eval_report(replace(made_eval(), until_width=0.1), COMMAND)).text
    assert "confidence sequence" in text
    assert "Wilson's score" not in text


def test_whatever_comes_from_outside_is_escaped():
    made = made_eval(EVIL, phases=(EVIL,), conditions=(EVIL, f"{EVIL}2"))
    episodes = tuple(
        replace(e, detail={**e.detail, "drawn": {EVIL: e.detail["goal"][0], "turn": {EVIL: [1.0, e.seed % 5]}}})
        for e in made.episodes
    )
    report = eval_report(replace(made, robot=EVIL, task=EVIL, fingerprint={EVIL: EVIL}, episodes=episodes), EVIL)
    assert page_of(report).text.count('alert("x")') >= 300
