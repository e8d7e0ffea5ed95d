"""Every page says first how good, then why, escapes what it is given, and says no less if
nothing or all fails.
"""

from dataclasses import replace
from pathlib import Path

import pytest

from manip_il.evaluation.eval_report import compare_report, curve_figures, eval_report, run_report
from manip_il.evaluation.report import Film
from manip_il.evaluation.side import Member, Side

from .made_evals import made_eval, made_pair, often, seldom
from .page import EVIL, Page, page_of
from .test_rounds import RUN

COMMAND = "manip-il eval --policy.path=runs/a/best --suite=all"
MP4 = b"\0\0\0\x18ftypisom" + b"\0" * 20
FILMS = [Film("Seed 3", MP4), Film("Seed 4", MP4)]
RESULT = made_eval()
REPORT = replace(eval_report(RESULT, FILMS), command=COMMAND, config={"eval": {"n_episodes": 120}})
SELDOM = made_pair(often, seldom)


@pytest.fixture(scope="module")
def page() -> Page:
    return page_of(REPORT)


def test_the_verdict_has_success_and_the_main_phase():
    phase, count = next(iter(RESULT.failures.items()))
    failed = 120 - RESULT.success.successes
    assert (
        REPORT.verdict
        == f"runs/a/best succeeds in {RESULT.success} of 120 unseen episodes of panda pick_place; "
        f"{count} of its {failed} failures end in the phase {phase}."
    )


def test_every_condition_is_in_the_table(page: Page):
    for name, part in RESULT.by_condition.items():
        assert f"{name} {part.success.n} {part.success}" in page.text


def test_a_run_has_its_policies_their_curves_and_how_it_was_made():
    sides = [
        Side.of("DAgger", RESULT, labels=1234, disturbed=RESULT),
        Side.of("cloning", RESULT, labels=400),
    ]
    curve = Side("DAgger", (Member(Path("x"), history=RUN),))
    config = {"policy": {"hidden": 256, "name": None}}
    page = page_of(
        run_report(
            sides, [curve], FILMS, title="t", verdict="DAgger wins.", command="c", config=config
        )
    )
    for words in ("1,234", "policy: hidden: 256 name: null"):
        assert words in page.text
    curves = [words for words in page.figures if "Validation" in words]
    assert curves == [
        f"Validation success over {cost}: DAgger" for cost in ("labels", "episodes", "seconds")
    ]


def test_a_comparison_tells_which_is_better_and_where_they_fail():
    page = page_of(compare_report(SELDOM, "t"))
    assert SELDOM.verdict.startswith("runs/dagger is better than runs/cloning by ")
    assert "Every policy ran 120 test episodes on the same seeds" in page.text
    assert "phase that it ended in" in page.text
    assert sum("Validation success over" in words for words in page.figures) == 3


def test_whatever_comes_from_outside_is_escaped():
    made = made_eval(EVIL, phases=(EVIL,), conditions=(EVIL, f"{EVIL}2"))
    evil = replace(made, robot=EVIL, task=EVIL, fingerprint={EVIL: EVIL})
    assert (
        page_of(
            replace(eval_report(evil, [Film(EVIL, MP4, EVIL)]), command=EVIL, config={EVIL: EVIL})
        ).text.count("alert")
        > 19
    )
    sides = tuple(Side.of(f"{EVIL}{side}", evil) for side in "lr")
    study = replace(SELDOM, sides=sides, baseline=sides[0].name)
    assert page_of(compare_report(study, EVIL)).text.count("alert") > 10


def test_a_figure_is_the_same_bytes_and_fits_a_phone():
    sides = [
        replace(SELDOM.sides[1], name="a $name_of$ many words that is rather long"),
        SELDOM.sides[0],
    ]
    once, again = curve_figures(sides)[0], curve_figures(sides)[0]
    assert once.svg == again.svg
    assert once.width <= 480  # or it would not be readable on a phone
