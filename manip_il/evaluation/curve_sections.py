"""Learning curves on a page, with their legends, notes and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from manip_il.evaluation import sections
from manip_il.evaluation.curve_charts import SHAPES, across, curve_axes, learning_curve, study_curve, success_axis
from manip_il.evaluation.report_data import (
    COSTS,
    ArmCurve,
    Cost,
    CurvePoint,
    LearningCurve,
    format_amount,
    format_percent,
)
from manip_il.evaluation.svg import Axis, element


def curve(data: LearningCurve) -> str:
    """Return the learning curve with its legend, and its numbers for those who cannot see it."""
    legend = [
        ("dagger", f"{data.name}, one point a round", bool(data.dagger)),
        ("cloning", "behaviour cloning", bool(data.cloning)),
        ("expert", f"expert, {data.expert and format_percent(data.expert.rate)}", data.expert is not None),
        ("target", f"target, {data.target and format_percent(data.target)}", data.target is not None),
    ]
    keys = "".join(f'<li><i class="key {kind}"></i>{escape(words)}</li>' for kind, words, shown in legend if shown)
    costs: list[Cost] = [cost for cost in COSTS if any(point.amount(cost) is not None for point in data.points)]
    drawn = [(learning_curve(data, cost), curve_axes(data, cost)[0].words) for cost in costs]
    note = f"Validation success; bars are {_confidence(data)} intervals."
    return sections.section(
        "Success against labels" if costs == ["labels"] else "Success against cost",
        curve_note(note, curve_axes(data)[1], timed="seconds" in costs),
        f'<ul class="legend">{keys}</ul>',
        plots(drawn),
        sections.details("The curve in numbers", _curve_table(data)),
    )


def arm_curves(arms: Sequence[tuple[ArmCurve, str]], target: float | None = None) -> str:
    """Return learning curves of several arms, each with the CSS class of its colour, over every cost that all know."""
    points = [point for arm, _ in arms for point in arm.points]
    costs: list[Cost] = [cost for cost in COSTS if all(point.amount(cost) is not None for point in points)]
    drawn = [
        (study_curve(arms, cost, target), across(cost, [point.amount(cost) or 0 for point in points]).words)
        for cost in costs
    ]
    keys = [f"<li>{_arm_key(index, kind)}{escape(arm.name)}</li>" for index, (arm, kind) in enumerate(arms)]
    if target is not None:
        keys.append(f'<li><i class="key target"></i>target, {format_percent(target)}</li>')
    y = success_axis([point.success for point in points], target)
    several = any(len(arm.runs) > 1 for arm, _ in arms)
    words = "Validation success by round, the mean over training seeds; thin lines are the seeds."
    single = "Validation success by round; bars are 95 % intervals."
    note = curve_note(words if several else single, y, timed="seconds" in costs)
    return f'{note}<ul class="legend">{"".join(keys)}</ul>{plots(drawn)}'


def curve_note(words: str, y: Axis, timed: bool) -> str:
    """What a curve shows, and where its axes begin and end."""
    cut = f" The axis of success starts at {y.low:.0f} %." if y.low > 0 else ""
    clock = " Wall-clock is collecting and fitting, without validating." if timed else ""
    return f'<p class="note">{sections.prose(words + clock + cut)}</p>'


def plots(drawn: Sequence[tuple[str, str]]) -> str:
    """Return charts with the words under their axes: the first as wide as the page, the others side by side."""
    each = [f'<div class="plot">{chart}<p class="x-title">{escape(words)}</p></div>' for chart, words in drawn]
    return f'<div class="plots">{"".join(each)}</div>'


def _arm_key(index: int, kind: str) -> str:
    shape = element("g", SHAPES[index % len(SHAPES)], class_=f"series {kind}")
    return element("svg", shape, class_="key-mark", viewBox="-8 -8 16 16", aria_hidden="true")


def _curve_table(data: LearningCurve) -> str:
    rows = [(kind, point) for kind, points in ((data.name, data.dagger), ("cloning", data.cloning)) for point in points]
    return sections.pairs({_point_name(kind, point): str(point.success) for kind, point in rows})


def _point_name(kind: str, point: CurvePoint) -> str:
    costs = [format_amount(cost, amount) for cost in COSTS if (amount := point.amount(cost)) is not None]
    return f"{kind}, {point.name + ', ' if point.name else ''}{', '.join(costs)}"


def _confidence(data: LearningCurve) -> str:
    return f"{100 * data.points[0].success.confidence:g} %"
