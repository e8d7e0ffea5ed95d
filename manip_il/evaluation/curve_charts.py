"""Learning curves as inline SVG: validation success over labels, episodes or wall-clock."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import fmean

from manip_il.evaluation.report_data import ArmCurve, Cost, CurvePoint, LearningCurve, format_amount, format_percent
from manip_il.evaluation.statistics import Proportion
from manip_il.evaluation.svg import Axis, axis_for, element, percent, text, title

DODGE = 5  # px that DAgger and cloning are moved apart where they share a number of labels
SHAPES = (  # around (0, 0) [px]; told apart without colour
    element("circle", class_="mark", r=5),
    element("rect", class_="mark", x=-4.5, y=-4.5, width=9, height=9),
    element("path", class_="mark", d="M0 -6.5 L6.5 0 L0 6.5 L-6.5 0 Z"),
    element("path", class_="mark", d="M0 -6 L6 5 L-6 5 Z"),
)
DAGGER, CLONING = SHAPES[0], SHAPES[1]
UNITS = ((3 * 3600.0, 3600.0, "h"), (300.0, 60.0, "min"), (0.0, 1.0, "s"))  # from this many seconds on; its seconds
NAMES: dict[Cost, str] = {"labels": "expert labels", "episodes": "episodes", "seconds": "wall-clock"}


@dataclass(frozen=True)
class Across:
    """The axis of what success had cost. unit: in which it is shown, in labels, episodes or seconds."""

    cost: Cost
    axis: Axis
    unit: float = 1.0
    words: str = ""

    def percent(self, amount: float) -> float:
        """Return where an amount lies [percent]."""
        return self.axis.percent(amount / self.unit)


def across(cost: Cost, amounts: Sequence[float], log: bool | None = None) -> Across:
    """Return an axis for these amounts, seconds in a unit that people read."""
    _, unit, name = next(one for one in UNITS if max(amounts) >= one[0]) if cost == "seconds" else (0, 1.0, "")
    axis = axis_for([amount / unit for amount in amounts], log)
    words = [NAMES[cost], f" [{name}]" if name else "", ", logarithmic" if axis.log else ""]
    return Across(cost, axis, unit, "".join(words))


def learning_curve(curve: LearningCurve, cost: Cost = "labels") -> str:
    """Draw success over `cost`: DAgger's rounds as a line, cloning as squares, expert and target as levels."""
    x, y = curve_axes(curve, cost)
    shared = {p.labels for p in curve.dagger} & {p.labels for p in curve.cloning}
    return _chart(
        x,
        y,
        _expert_level(curve.expert, y) if curve.expert else "",
        _target_level(curve.target, y),
        _series(_known(curve.cloning, cost), x, y, "cloning", CLONING, DODGE if shared else 0),
        _series(_known(curve.dagger, cost), x, y, "dagger", DAGGER, -DODGE if shared else 0),
    )


def study_curve(arms: Sequence[tuple[ArmCurve, str]], cost: Cost, target: float | None = None) -> str:
    """Return every arm with its kind (a CSS class).

    The mean over training seeds by round, and each seed as a thin line.
    """
    x = across(cost, [amount for arm, _ in arms for amount in _amounts(arm.points, cost)])
    y = success_axis([point.success for arm, _ in arms for point in arm.points], target)
    lines = [
        _arm(arm, x, y, kind, SHAPES[index % len(SHAPES)]) for index, (arm, kind) in reversed(list(enumerate(arms)))
    ]
    return _chart(x, y, _target_level(target, y), *lines)


def curve_axes(curve: LearningCurve, cost: Cost = "labels") -> tuple[Across, Axis]:
    """Return cost across, success upwards [percent]."""
    proportions = [*(point.success for point in curve.points), *([curve.expert] if curve.expert else [])]
    x = across(cost, _amounts(curve.points, cost), curve.log_x if cost == "labels" else None)
    return x, success_axis(proportions, curve.target)


def success_axis(proportions: Sequence[Proportion], target: float | None = None) -> Axis:
    """From 0, or from as high as nothing is left out, to 100 [percent]."""
    # Points, unlike bars, may start above 0: where all is well, the differences are what is read.
    lowest = 100 * min([p.interval[0] for p in proportions] + ([] if target is None else [target]))
    return Axis(10.0 * math.floor(lowest / 10) if lowest > 50 else 0.0, 100.0)


def _known(points: Sequence[CurvePoint], cost: Cost) -> list[CurvePoint]:
    return [point for point in points if point.amount(cost) is not None]


def _amounts(points: Sequence[CurvePoint], cost: Cost) -> list[float]:
    return [_amount(point, cost) for point in _known(points, cost)]


def _amount(point: CurvePoint, cost: Cost) -> float:
    amount = point.amount(cost)
    assert amount is not None
    return amount


def _chart(x: Across, y: Axis, *layers: str) -> str:
    words = title(f"Validation success over {NAMES[x.cost]}")
    return element("svg", words, _y_grid(y), _x_ticks(x.axis), *layers, class_="curve", role="img")


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
    if value >= 10_000:
        return f"{value / 1000:g}k"
    return f"{value:,.0f}" if value >= 10 or value == round(value) else f"{value:g}"


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


def _target_level(target: float | None, y: Axis) -> str:
    if target is None:
        return ""
    level = percent(100 - y.percent(100 * target))
    line = element("line", class_="target-level", x1=0, x2="100%", y1=level, y2=level)
    return element("g", title(f"target: {format_percent(target)}"), line)


def _series(points: Sequence[CurvePoint], x: Across, y: Axis, kind: str, shape: str, shift: int) -> str:
    joins = _joins([_place(point, x, y) for point in points])
    marks = [_mark(point, x, y, shape) for point in points]
    return element("g", *joins, *marks, class_=f"series {kind}", transform=f"translate({shift} 0)")


def _arm(arm: ArmCurve, x: Across, y: Axis, kind: str, shape: str) -> str:
    runs = [_known(run, x.cost) for run in arm.runs]
    if len(runs) == 1:
        named = [f"{arm.name}, {point.name}" for point in runs[0]]
        marks = [_mark(point, x, y, shape, name) for point, name in zip(runs[0], named, strict=True)]
        return element("g", *_joins([_place(point, x, y) for point in runs[0]]), *marks, class_=f"series {kind}")
    thin = [element("g", *_joins([_place(point, x, y) for point in run]), class_="thin") for run in runs]
    means: list[tuple[float, float]] = []
    marks = []
    # Only rounds that every seed has: else the mean would jump where a seed ends.
    for points in zip(*runs, strict=False):
        amount, rate = fmean(_amount(p, x.cost) for p in points), fmean(p.success.rate for p in points)
        means.append((x.percent(amount), 100 - y.percent(100 * rate)))
        words = f"{arm.name}, {points[0].name}, {format_amount(x.cost, amount)}: {format_percent(rate)} on average"
        marks.append(element("g", title(words), _shape(shape, *means[-1])))
    return element("g", *thin, *_joins(means), *marks, class_=f"series {kind}")


def _joins(places: Sequence[tuple[float, float]]) -> list[str]:
    return [
        element("line", class_="join", x1=percent(a[0]), y1=percent(a[1]), x2=percent(b[0]), y2=percent(b[1]))
        for a, b in pairwise(places)
    ]


def _place(point: CurvePoint, x: Across, y: Axis) -> tuple[float, float]:
    """Percent across and percent down."""
    return x.percent(_amount(point, x.cost)), 100 - y.percent(100 * point.success.rate)


def _mark(point: CurvePoint, x: Across, y: Axis, shape: str, name: str | None = None) -> str:
    low, high = point.success.interval
    place = _place(point, x, y)
    name = point.name if name is None else name
    words = f"{name + ', ' if name else ''}{format_amount(x.cost, _amount(point, x.cost))}: {point.success}"
    whisker = whisker_down(place[0], 100 - y.percent(100 * high), 100 - y.percent(100 * low))
    return element("g", title(words), whisker, _shape(shape, *place))


def _shape(shape: str, across: float, down: float) -> str:
    return element("svg", shape, x=percent(across), y=percent(down), overflow="visible")


def whisker_down(across: float, top: float, bottom: float) -> str:
    """Return an interval as a line with caps, at percent `across` between percent `top` and `bottom`."""
    at, a, b = percent(across), percent(top), percent(bottom)
    cap = {"class_": "cap", "x": at, "width": 8, "height": 1.5}
    return element(
        "g",
        element("line", x1=at, x2=at, y1=a, y2=b),
        element("rect", y=a, transform="translate(-4 -0.75)", **cap),
        element("rect", y=b, transform="translate(-4 -0.75)", **cap),
        class_="whisker",
    )
