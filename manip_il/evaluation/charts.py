"""Bars of a report as inline SVG: success with its interval, or over training seeds."""

from __future__ import annotations

from collections.abc import Sequence

from manip_il.evaluation.report_data import PolicyRow, format_percent
from manip_il.evaluation.statistics import Proportion
from manip_il.evaluation.svg import element, percent, title

BAR_HEIGHT = 26  # px


def success_bar(row: PolicyRow) -> str:
    """Return one bar from 0 to 100 % with its interval as a whisker; as wide as what it stands in."""
    return _bar(row.name, row.kind, row.success)


def seeds_bar(name: str, kind: str, successes: Sequence[Proportion]) -> str:
    """Return one bar of the mean over training seeds, each seed a dot; of one seed, its interval."""
    if len(successes) == 1:
        return _bar(name, kind, successes[0])
    rates = [one.rate for one in successes]
    mean = sum(rates) / len(rates)
    dots = [element("circle", class_="seed", cx=percent(100 * rate), cy=BAR_HEIGHT / 2, r=4) for rate in rates]
    words = f"{name}: {format_percent(mean)}, training seeds {', '.join(map(format_percent, rates))}"
    return _frame(words, kind, mean, "".join(dots))


def _bar(name: str, kind: str, success: Proportion) -> str:
    low, high = success.interval
    return _frame(f"{name}: {success}", kind, success.rate, _whisker_across(100 * low, 100 * high, BAR_HEIGHT / 2))


def _frame(words: str, kind: str, rate: float, marks: str) -> str:
    return element(
        "svg",
        title(words),
        element("rect", class_="track", width="100%", height=BAR_HEIGHT, rx=4),
        element("rect", class_=f"bar {kind}", width=percent(100 * rate), height=BAR_HEIGHT, rx=4),
        marks,
        class_="bar-chart",
        role="img",
        width="100%",
        height=BAR_HEIGHT,
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
