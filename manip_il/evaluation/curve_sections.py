"""Learning curves on a page, with their legends, notes and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from manip_il.evaluation import sections
from manip_il.evaluation.curve_charts import curve_axes, learning_curve
from manip_il.evaluation.report_data import COSTS, Cost, CurvePoint, LearningCurve, format_amount, format_percent
from manip_il.evaluation.svg import Axis


def curve(data: LearningCurve) -> str:
    """The learning curve with its legend, and its numbers for those who cannot see it."""
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
        "What the labels bought" if costs == ["labels"] else "What success cost",
        curve_note(note, curve_axes(data)[1], timed="seconds" in costs),
        f'<ul class="legend">{keys}</ul>',
        plots(drawn),
        sections.details("The curve in numbers", _curve_table(data)),
    )


def curve_note(words: str, y: Axis, timed: bool) -> str:
    """What a curve shows, and where its axes begin and end."""
    cut = f" The axis of success starts at {y.low:.0f} %." if y.low > 0 else ""
    clock = " Wall-clock is collecting and fitting, without validating." if timed else ""
    return f'<p class="note">{sections.prose(words + clock + cut)}</p>'


def plots(drawn: Sequence[tuple[str, str]]) -> str:
    """Charts with the words under their axes: the first as wide as the page, the others side by side."""
    each = [f'<div class="plot">{chart}<p class="x-title">{escape(words)}</p></div>' for chart, words in drawn]
    return f'<div class="plots">{"".join(each)}</div>'


def _curve_table(data: LearningCurve) -> str:
    rows = [(kind, point) for kind, points in ((data.name, data.dagger), ("cloning", data.cloning)) for point in points]
    return sections.pairs({_point_name(kind, point): str(point.success) for kind, point in rows})


def _point_name(kind: str, point: CurvePoint) -> str:
    costs = [format_amount(cost, amount) for cost in COSTS if (amount := point.amount(cost)) is not None]
    return f"{kind}, {point.name + ', ' if point.name else ''}{', '.join(costs)}"


def _confidence(data: LearningCurve) -> str:
    return f"{100 * data.points[0].success.confidence:g} %"
