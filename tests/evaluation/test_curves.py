"""Charts of success over what it cost have readable axes and show every point, seed and mean."""

from dataclasses import replace

import pytest

from manip_il.errors import ManipError
from manip_il.evaluation.curves import Axis, CostAxis, CurveCharts, Series
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.report_data import CurvePoint, LearningCurve
from manip_il.evaluation.rounds import curve_points, history

from .page import page_of
from .test_report import CURVE, REPORT
from .test_rounds import records


def test_a_wide_span_of_labels_takes_a_logarithmic_axis_and_one_point_has_an_axis():
    spans = ([100, 1000], [100, 10_000], [0, 10_000])
    assert [Axis.around(span).log for span in spans] == [False, True, False]
    assert 0 < Axis.around([500]).percent(500) < 100


@pytest.mark.parametrize(
    "axis", [Axis(0, 100), Axis(1, 2), Axis(900, 6800), Axis(30, 2e6, log=True), Axis(450, 9e3, log=True)]
)
def test_ticks_are_few_lie_on_the_axis_and_keep_their_order(axis: Axis):
    ticks = axis.ticks()
    places = [axis.percent(tick) for tick in ticks]
    assert 2 <= len(ticks) <= 6
    assert all(0 <= place <= 100 for place in places)
    assert places == sorted(places)


@pytest.mark.parametrize(
    ("longest", "unit", "words"), [(200.0, 1, "[s]"), (1_000.0, 60, "[min]"), (20_000.0, 3600, "[h]")]
)
def test_wall_clock_is_shown_in_a_readable_unit(longest: float, unit: float, words: str):
    x = CostAxis.around("seconds", [longest / 2, longest])
    assert x.unit == unit
    assert x.label.endswith(words)
    assert 0 < x.percent(longest / 2) < x.percent(longest) < 100


def test_a_curve_with_all_costs_is_drawn_over_each_of_them():
    points = tuple(
        CurvePoint(100 * i, Proportion(10 * i, 40), f"round {i}", episodes=5 * i, seconds=400.0 * i) for i in (1, 2, 3)
    )
    page = page_of(replace(REPORT, curve=LearningCurve(points)))
    assert (page.count("curve"), page.count("mark")) == (3, 1 + 9)  # one in the legend
    for words in ("expert labels", "wall-clock [min]", "round 2, 200 labels, 10 episodes, 13 min 20 s"):
        assert words in page.text


def test_a_curve_with_labels_alone_is_drawn_once():
    page = page_of(REPORT)
    assert page.count("curve") == 1
    assert "Success against labels" in page.text
    assert [one.series.shift for one in CurveCharts.of(CURVE).charts[0].series] == [5, -5]  # they share 1,230 labels


def test_thousands_of_one_axis_are_written_alike():
    points = tuple(CurvePoint(labels, Proportion(10, 40), "") for labels in (4_000, 18_000))
    [chart] = CurveCharts((Series("a", "arm", {"": points}),)).charts
    assert [label for label, _ in chart.x_ticks] == ["5k", "10k", "15k"]


def test_a_mark_lies_at_its_cost_and_rate_with_its_interval():
    [chart] = CurveCharts.of(replace(CURVE, cloning=())).charts
    [drawn] = chart.series
    for mark, point in zip(drawn.marks, CURVE.dagger, strict=True):
        low, high = point.success.interval
        places = [100 - chart.y.percent(100 * share) for share in (point.success.rate, high, low)]
        assert [mark.y, *(mark.whisker or ())] == pytest.approx(places)
        assert mark.x == pytest.approx(chart.x.percent(point.labels))
        assert mark.words == f"DAgger, {point.name}, {point.labels:,} labels: {point.success}"


def test_thin_lines_are_the_seeds_and_marks_their_mean():
    fast, slow = (0.5, 0.9, 0.9, 1.0), (0.3, 0.5, 0.9, 0.8)
    runs = {str(i): curve_points(history(records(s), "x")) for i, s in enumerate((fast, slow, fast[:2]))}
    [drawn] = CurveCharts((Series("dagger", "arm", runs),)).charts[0].series
    assert [len(line) for line in drawn.thin] == [4, 4, 2]
    assert len(drawn.marks) == 2  # rounds that every seed has
    assert drawn.marks[1].words == "dagger, round 1, 200 labels: 76.7 % on average"


def test_the_axis_of_success_starts_above_0_only_where_nothing_is_left_out():
    high = CurvePoint(10, Proportion(990, 1000))
    assert CurveCharts.of(LearningCurve((high,))).y.low == 90
    assert "starts at 90 %" in CurveCharts.of(LearningCurve((high,))).note
    assert CurveCharts((Series("a", "arm", {"": (high,)}),), target=0.6).y.low == 60
    assert CurveCharts.of(CURVE).y.low == 0


def test_what_is_no_curve_is_refused():
    with pytest.raises(ManipError, match=r"-1.0 seconds"):
        CurvePoint(1, Proportion(1, 2), seconds=-1.0)
    with pytest.raises(ManipError, match="without a round"):
        Series("a", "arm", {"training seed 0": ()})
