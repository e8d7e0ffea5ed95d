"""The page of a comparison shows in which episodes the two differ."""

from dataclasses import replace

import pytest

from manip_il.evaluation.compare_report import compare_report, condition_table
from manip_il.evaluation.comparison import Arm, Comparison

from .made_evals import far_corner, made_comparison, made_eval, without_detail
from .page import EVIL, Page, page_of

COMMAND = "manip-il compare runs/cloning runs/dagger"
SELDOM = made_comparison(far_corner, lambda number, _: number % 37 == 0)


def page_of_comparison(comparison: Comparison) -> Page:
    return page_of(compare_report(comparison, COMMAND, ["Of every run the last round."]))


@pytest.fixture(scope="module")
def page() -> Page:
    return page_of_comparison(SELDOM)


def test_the_verdict_comes_first(page: Page):
    assert SELDOM.verdict.startswith("runs/dagger is better than runs/cloning by ")
    assert page.text.index(SELDOM.verdict) < page.text.index("Of 120 paired") < page.text.index("Results")
    assert "Of every run the last round." in page.text


def test_the_four_counts_are_told_in_words_and_as_a_table(page: Page):
    [pair] = SELDOM.pairs
    assert (
        f"Of 120 paired episodes both solved {pair.both}, only runs/dagger {pair.only_right}, "
        f"only runs/cloning {pair.only_left}, and neither {pair.neither}."
    ) in page.text
    assert f"test episodes 120 {pair.both} {pair.only_left} {pair.only_right} {pair.neither} < 0.001" in page.text


def test_bars_are_as_long_as_the_rates(page: Page):
    assert page.bar_widths("arm")[:2] == [f"{100 * arm.test_rate:.2f}%" for arm in (SELDOM.left, SELDOM.right)]


def test_both_maps_and_curves_are_there(page: Page):
    assert sum((a.get("class") or "").startswith("paths map") for _, a in page.tags) == 4
    assert "only this one failed" in page.text
    assert page.count("curve") == 3
    assert "Success against cost" in page.text


def test_conditions_are_compared_pair_by_pair():
    def knocked(number: int, detail: dict) -> bool:
        return detail["condition"] == "knocked"

    table = condition_table(made_comparison(knocked, lambda *_: False))
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["knocked"] == ("40", "0.0 %", "100.0 %", "+100.0 points", "p < 0.001")
    assert rows["nominal"] == ("40", "100.0 %", "100.0 %", "+0.0 points", "p = 1.000")
    assert table.columns[2:4] == ("runs/cloning", "runs/dagger")


def test_training_seeds_have_a_line_each():
    page = page_of_comparison(made_comparison(far_corner, lambda *_: False, seeds=3))
    for seed in range(3):
        assert f"training seed {seed} 120" in page.text
    assert "Of 360 paired episodes of 3 training seeds" in page.text
    assert "Dots: each training seed" in page.text


def test_without_histories_and_details_the_numbers_alone_are_left():
    bare = [
        Arm(arm.name, tuple(replace(m, history=(), chosen=None, result=without_detail(m.result)) for m in arm.members))
        for arm in (SELDOM.left, SELDOM.right)
    ]
    page = page_of_comparison(Comparison(*bare))
    for word in ("Where they fail", "Success against cost", "By condition"):
        assert word not in page.text
    assert "Episode by episode" in page.text


def test_equal_sides_are_not_told_apart():
    page = page_of_comparison(made_comparison(far_corner, far_corner))
    assert "No difference shown" in page.text
    assert "only this one failed" not in page.text


def test_both_fingerprints_are_there_where_they_differ():
    result = replace(made_eval(fails=lambda *_: False), fingerprint={"mujoco": "9"})
    other = replace(SELDOM.right.members[0], result=result)
    text = page_of_comparison(Comparison(SELDOM.left, Arm("runs/dagger", (other,)))).text
    assert "runs/dagger.mujoco 9" in text
    assert "runs/cloning.mujoco 3.11.0" in text


def test_whatever_comes_from_outside_is_escaped():
    result = made_eval(EVIL, conditions=(EVIL, "b"))
    arms = [
        Arm(name, tuple(replace(member, name=name, result=result) for member in arm.members))
        for name, arm in zip((f"{EVIL}l", f"{EVIL}r"), SELDOM.arms, strict=True)
    ]
    report = compare_report(Comparison(*arms), EVIL, (EVIL,), {EVIL: EVIL})
    assert page_of(report).text.count('alert("x")') >= 20
