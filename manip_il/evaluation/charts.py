"""Charts of a report as inline SVG: success bars and the learning curve."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from manip_il.evaluation.report_data import CurvePoint, LearningCurve, PolicyRow
from manip_il.evaluation.statistics import Proportion
from manip_il.evaluation.svg import Axis, axis_for, element, percent, text, title

DODGE = 5  # px that DAgger and cloning are moved apart where they share a number of labels
BAR_HEIGHT = 26  # px


def success_bar(row: PolicyRow) -> str:
    """One bar from 0 to 100 % with its interval as a whisker; as wide as what it stands in."""
    low, high = row.success.interval
    middle = BAR_HEIGHT / 2
    return element(
        "svg",
        title(f"{row.name}: {row.success}"),
        element("rect", class_="track", width="100%", height=BAR_HEIGHT, rx=4),
        element("rect", class_=f"bar {row.kind}", width=percent(100 * row.success.rate), height=BAR_HEIGHT, rx=4),
        _whisker_across(100 * low, 100 * high, middle),
        class_="bar-chart",
        role="img",
        width="100%",
        height=BAR_HEIGHT,
    )


def learning_curve(curve: LearningCurve) -> str:
    """Success over expert labels: rounds of DAgger joined by a line, cloning as squares, the expert as a level."""
    x, y = curve_axes(curve)
    shared = {p.labels for p in curve.dagger} & {p.labels for p in curve.cloning}
    return element(
        "svg",
        title("Validation success over the number of expert labels"),
        _y_grid(y),
        _x_ticks(x),
        _expert_level(curve.expert, y) if curve.expert else "",
        _series(curve.cloning, x, y, "cloning", DODGE if shared else 0),
        _series(curve.dagger, x, y, "dagger", -DODGE if shared else 0),
        class_="curve",
        role="img",
    )


def curve_axes(curve: LearningCurve) -> tuple[Axis, Axis]:
    """Expert labels across, success upwards [percent]."""
    proportions = [*(point.success for point in curve.points), *([curve.expert] if curve.expert else [])]
    return axis_for([point.labels for point in curve.points], curve.log_x), _success_axis(proportions)


def _success_axis(proportions: Sequence[Proportion]) -> Axis:
    # Points, unlike bars, may start above 0: where all is well, the differences are what is read.
    lowest = 100 * min(p.interval[0] for p in proportions)
    return Axis(10.0 * math.floor(lowest / 10) if lowest > 50 else 0.0, 100.0)


def _y_grid(y: Axis) -> str:
    lines: list[str] = []
    for tick in y.ticks():
        at = percent(100 - y.percent(tick))
        lines.append(element("line", class_="grid", x1=0, x2="100%", y1=at, y2=at))
        lines.append(text(f"{tick:.0f} %", class_="tick", x=-8, y=at, dy="0.35em", text_anchor="end"))
    return "".join(lines)


def _x_ticks(x: Axis) -> str:
    ticks: list[str] = []
    for tick in x.ticks():
        at = percent(x.percent(tick))
        ticks.append(element("line", class_="grid", x1=at, x2=at, y1=0, y2="100%"))
        ticks.append(text(_count(tick), class_="tick", x=at, y="100%", dy="1.5em", text_anchor="middle"))
    return "".join(ticks)


def _count(value: float) -> str:
    return f"{value / 1000:g}k" if value >= 10_000 else f"{value:,.0f}"


def _expert_level(expert: Proportion, y: Axis) -> str:
    low, high = expert.interval
    top, bottom = 100 - y.percent(100 * high), 100 - y.percent(100 * low)
    level = percent(100 - y.percent(100 * expert.rate))
    return element(
        "g",
        title(f"expert: {expert}"),
        element("rect", class_="expert-band", width="100%", y=percent(top), height=percent(bottom - top)),
        element("line", class_="expert-level", x1=0, x2="100%", y1=level, y2=level),
    )


def _series(points: Sequence[CurvePoint], x: Axis, y: Axis, kind: str, shift: int) -> str:
    at = [(x.percent(p.labels), 100 - y.percent(100 * p.success.rate)) for p in points]
    joins = [
        element("line", class_="join", x1=percent(a[0]), y1=percent(a[1]), x2=percent(b[0]), y2=percent(b[1]))
        for a, b in pairwise(at)
    ]
    marks = [_mark(point, place, y, kind) for point, place in zip(points, at, strict=True)]
    return element("g", *joins, *marks, class_=f"series {kind}", transform=f"translate({shift} 0)")


def _mark(point: CurvePoint, place: tuple[float, float], y: Axis, kind: str) -> str:
    low, high = point.success.interval
    across, down = percent(place[0]), percent(place[1])
    name = f"{point.name}, " if point.name else ""
    shape = (
        element("circle", class_="mark", cx=across, cy=down, r=5)
        if kind == "dagger"
        else element("rect", class_="mark", x=across, y=down, width=9, height=9, transform="translate(-4.5 -4.5)")
    )
    return element(
        "g",
        title(f"{name}{point.labels:,} labels: {point.success}"),
        _whisker_down(place[0], 100 - y.percent(100 * high), 100 - y.percent(100 * low)),
        shape,
    )


def _whisker_across(low: float, high: float, middle: float) -> str:
    a, b = percent(low), percent(high)
    lines = [
        element("line", x1=a, x2=b, y1=middle, y2=middle),
        element("line", x1=a, x2=a, y1=middle - 5, y2=middle + 5),
        element("line", x1=b, x2=b, y1=middle - 5, y2=middle + 5),
    ]
    # Drawn twice: the pale one below parts the dark one from the bar's colour.
    return element("g", *lines, class_="halo") + element("g", *lines, class_="whisker")


def _whisker_down(across: float, top: float, bottom: float) -> str:
    at, a, b = percent(across), percent(top), percent(bottom)
    cap = {"class_": "cap", "x": at, "width": 8, "height": 1.5}
    return element(
        "g",
        element("line", x1=at, x2=at, y1=a, y2=b),
        element("rect", y=a, transform="translate(-4 -0.75)", **cap),
        element("rect", y=b, transform="translate(-4 -0.75)", **cap),
        class_="whisker",
    )
