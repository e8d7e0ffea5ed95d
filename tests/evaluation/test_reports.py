"""Every page says first how good, then why, escapes what it is given, and says no less if nothing or all fails."""

from dataclasses import replace
from pathlib import Path

import pytest

from manip_il.evaluation.arm import Arm
from manip_il.evaluation.eval_report import compare_report, eval_report, run_report
from manip_il.evaluation.figures import Bar, Curve, curve_figures, rates_figure
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.report import Film
from manip_il.evaluation.rounds import history
from manip_il.evaluation.tables import CLONING, PolicyRow

from .made_evals import far_corner, made_eval, made_pair
from .page import EVIL, Page, page_of
from .test_rounds import RUN, records

COMMAND = "manip-il eval --policy.path=runs/a/best --suite=all"
MP4, JPEG = b"\0\0\0\x18ftypisom" + b"\0" * 20, b"\xff\xd8\xff\xe0" + b"\0" * 20
FILMS = [Film("Seed 3", MP4, poster=JPEG), Film("Seed 4", MP4), Film("Seed 5", MP4)]
RESULT = made_eval()
REPORT = eval_report(RESULT, COMMAND, {"eval": {"n_episodes": 120}}, FILMS)
SELDOM = made_pair(far_corner, lambda number, _: number % 37 == 0)


@pytest.fixture(scope="module")
def page() -> Page:
    return page_of(REPORT)


def test_the_verdict_has_success_and_the_main_phase():
    phase, count = next(iter(RESULT.failures.items()))
    failed = 120 - RESULT.success.successes
    assert REPORT.verdict == (
        f"runs/a/best succeeds in {RESULT.success} of 120 unseen episodes of panda pick_place; "
        f"{count} of its {failed} failures end in the phase {phase}."
    )


def test_every_condition_is_in_the_table_and_the_figure(page: Page):
    for name, part in RESULT.by_condition.items():
        assert f"{name} {part.success.n} {part.success}" in page.text
        assert f"{name}: {part.success}" in page.figures[0]


def test_a_run_has_its_policies_their_curves_and_how_it_was_made():
    rows = [PolicyRow("DAgger", RESULT, 1234, RESULT), PolicyRow("cloning", RESULT, 400, colour=CLONING)]
    beside = Curve("cloning", (RUN[:1],), CLONING, ("labels",))
    page = page_of(
        run_report(
            rows, FILMS, curves=[Curve("DAgger", (RUN,)), beside], title="t", verdict="DAgger wins.", command="c",
            config={"policy": {"hidden": 256, "name": None}},
        )
    )  # fmt: skip
    for words in ("1,234", "policy: hidden: 256 name: null"):
        assert words in page.text
    curves = [words for words in page.figures if "Validation" in words]
    assert curves[0] == "Validation success over labels: DAgger, cloning"
    assert [words.partition(": ")[2] for words in curves[1:]] == ["DAgger"] * (len(curves) - 1)


def test_a_comparison_tells_which_is_better_and_where_they_fail():
    page = page_of(compare_report(SELDOM, "t", COMMAND))
    assert SELDOM.verdict.startswith("runs/dagger is better than runs/cloning by ")
    assert "Every policy ran the same 120 test episodes" in page.text
    assert "phase that it ended in" in page.text
    assert sum("Validation success over" in words for words in page.figures) == 3


def test_whatever_comes_from_outside_is_escaped():
    made = made_eval(EVIL, phases=(EVIL,), conditions=(EVIL, f"{EVIL}2"))
    evil = replace(made, robot=EVIL, task=EVIL, fingerprint={EVIL: EVIL})
    assert page_of(eval_report(evil, EVIL, {EVIL: EVIL}, [Film(EVIL, MP4, EVIL)], EVIL)).text.count("alert") > 20
    arms = tuple(
        Arm(f"{EVIL}{side}", tuple(replace(one, path=Path(EVIL), result=evil) for one in arm.members))
        for side, arm in zip("lr", SELDOM.arms, strict=True)
    )
    study = replace(SELDOM, arms=arms, baseline=arms[0].name)
    assert page_of(compare_report(study, EVIL, EVIL)).text.count("alert") > 10


def test_a_figure_is_the_same_bytes_and_fits_a_phone():
    bars = [Bar("a $name_of$ many words that is rather long", (Proportion(3, 4),)), Bar("b", (Proportion(1, 4),) * 2)]
    assert rates_figure(bars).svg == rates_figure(bars).svg
    assert rates_figure(bars).width <= 480  # or it would not be readable on a phone
    seeds = Curve("two", (RUN, history(records((0.5, 0.6)), "x")))
    assert len(curve_figures([seeds], target=0.9)) == 3
