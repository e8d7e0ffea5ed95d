"""Figures of reports, drawn by matplotlib as SVG: success rates, learning curves, and the starts of failed episodes.

A panel is as wide as a phone's screen, so that its text stays readable there; wide windows show panels side by side.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np

from manip_il.evaluation.intervals import CONFIDENCE, Proportion, format_percent
from manip_il.evaluation.results import EpisodeResult
from manip_il.evaluation.rounds import COSTS, Cost, History, has_unlabelled_steps
from manip_il.evaluation.tables import BASELINE, CLONING, DAGGER, EXPERT

INK, SOFT, RULE = "#1d2126", "#5b636d", "#e3e5e8"
ARMS = (DAGGER, CLONING, EXPERT, "#a6408a", "#9a6f00", "#2f8fc4", "#7a4a2b")
_MARKERS = "osD^"  # distinguishable without colour
_PANEL = (4.4, 3.0)  # size of a figure placed beside others [inches]
_NAME = 20  # characters per line of a bar's name
_COST_WORDS = {"labels": "expert labels", "steps": "simulated steps", "seconds": "wall-clock [s]"}
_DPI = 96
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "path",  # looks the same whatever fonts a machine has
    "svg.hashsalt": "manip_il",  # so that equal figures have equal bytes
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # comes with matplotlib
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.edgecolor": SOFT,
    "axes.labelcolor": SOFT,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "axes.grid": True,
    "grid.color": RULE,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8,
}


@dataclass(frozen=True)
class Figure:
    """A picture in a report. svg: the file's content; words: alternative text; width: natural width [px]."""

    svg: bytes
    words: str
    width: int = 0


@contextmanager
def drawing(
    columns: int, rows: int = 1, size: tuple[float, float] = (3.2, 2.7), *, share: bool = False
) -> Iterator[tuple[Any, Any]]:
    """Yield a figure and its axes (rows, columns) in the reports' style.

    size: size of one panel [inches]. share: whether the panels of a row share their axes.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure as Drawn

    with mpl.rc_context(_STYLE):
        drawn = Drawn((size[0] * columns, size[1] * rows), layout="constrained")
        FigureCanvasSVG(drawn)
        axes = drawn.subplots(
            rows, columns, squeeze=False, sharex="row" if share else False, sharey="row" if share else False
        )
        yield drawn, axes


def to_figure(drawn: Any, words: str) -> Figure:
    """Return a drawn figure as part of a report; call it inside `with drawing(...)`."""
    content = io.BytesIO()
    drawn.savefig(content, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    return Figure(content.getvalue(), words, round(_DPI * drawn.get_figwidth()))


def plain(text: str) -> str:
    """Return text with matplotlib's maths markup escaped and unprintable characters replaced by `?`."""
    return "".join(one if one.isprintable() else "?" for one in text).replace("$", r"\$")


@dataclass(frozen=True)
class Bar:
    """Success rates of one arm: one rate with its interval, or one per training seed, with their mean as the bar."""

    name: str
    successes: tuple[Proportion, ...]
    colour: str = DAGGER


def rates_figure(bars: Sequence[Bar]) -> Figure:
    """Draw success rates as bars from 0 to 100 %, with intervals, or with one dot per training seed."""
    names = [textwrap.fill(plain(bar.name), _NAME) for bar in bars]
    height = 0.55 + sum(0.24 + 0.14 * (1 + name.count("\n")) for name in names)
    with drawing(1, size=(4.4, height)) as (drawn, axes):
        axis = axes[0, 0]
        for place, bar in enumerate(bars):
            rates = [100 * one.rate for one in bar.successes]
            mean = fmean(rates)
            axis.barh(place, mean, 0.62, color=bar.colour)
            if len(rates) == 1:
                low, high = (100 * end for end in bar.successes[0].interval)
                error = [[max(0.0, mean - low)], [max(0.0, high - mean)]]
                for width, colour in ((4.0, "white"), (1.4, INK)):  # white outline, to stand out on the bar
                    axis.errorbar(mean, place, xerr=error, color=colour, lw=width, capsize=3, capthick=width)
            else:
                axis.plot(rates, [place] * len(rates), "o", mfc="white", mec=INK, ms=5)
            axis.text(103, place, format_percent(mean / 100), va="center", weight="bold", color=INK)
        axis.set_yticks(range(len(bars)), names, color=INK)
        axis.set_xticks((0, 50, 100), ("0 %", "50 %", "100 %"))
        axis.set(xlim=(0, 122), ylim=(len(bars) - 0.45, -0.55))
        axis.grid(visible=False, axis="y")
        axis.tick_params(length=0)
        axis.spines[["left", "bottom"]].set_visible(False)
        return to_figure(drawn, "; ".join(f"{bar.name}: {', '.join(map(str, bar.successes))}" for bar in bars))


@dataclass(frozen=True)
class Curve:
    """Validation success by round for one arm, one run per training seed. costs: those that are known (labels, ...)."""

    name: str
    runs: tuple[History, ...]
    colour: str = DAGGER
    costs: tuple[Cost, ...] = COSTS


def curve_figures(curves: Sequence[Curve], target: float | None = None) -> tuple[Figure, ...]:
    """Draw success against every known cost, one figure each. target: drawn as a horizontal line, in [0, 1].

    Steps are omitted if every step was labelled, as they then equal the labels.
    """
    queried = not any(has_unlabelled_steps(run) for curve in curves for run in curve.runs)
    figures: list[Figure] = []
    for cost in COSTS:
        if not any(cost in curve.costs for curve in curves) or (cost == "steps" and queried):
            continue
        shown = [curve for curve in curves if cost in curve.costs]
        with drawing(1, size=_PANEL) as (drawn, axes):
            _draw_curves(axes[0, 0], shown, cost, target)
            if len(curves) > 1 or target is not None:
                drawn.legend(loc="outside upper left", ncols=2)
            figures.append(to_figure(drawn, f"Validation success over {cost}: {', '.join(one.name for one in shown)}"))
    return tuple(figures)


def _draw_curves(axis: Any, curves: Sequence[Curve], cost: Cost, target: float | None) -> None:
    for place, curve in enumerate(curves):
        style: dict[str, Any] = {"color": curve.colour, "marker": _MARKERS[place % len(_MARKERS)]}
        style["label"] = plain(textwrap.shorten(curve.name, 40))
        lines = [([one.amount(cost) for one in run], [100 * one.validation.rate for one in run]) for run in curve.runs]
        if len(lines) == 1:
            [(x, y)], [run] = lines, curve.runs
            ends = [[100 * abs(one.validation.rate - one.validation.interval[side]) for one in run] for side in (0, 1)]
            axis.errorbar(x, y, yerr=ends, capsize=3, ms=5, lw=1.6, **style)
            continue
        for x, y in lines:
            axis.plot(x, y, color=curve.colour, lw=0.9, alpha=0.4)
        # Only rounds that every seed's run has: otherwise the mean would jump where a run ends.
        xs, ys = ([*map(fmean, zip(*part, strict=False))] for part in zip(*lines, strict=True))
        axis.plot(xs, ys, lw=1.8, ms=5, **style)
    if target is not None:
        axis.axhline(100 * target, color=INK, ls="--", lw=1, label=f"target, {format_percent(target)}")
    axis.set(xlabel=_COST_WORDS.get(cost, cost), ylim=(-2, 102), ylabel="validation success [%]")


def curve_note(curves: Sequence[Curve]) -> str:
    """Return a note on the meaning of the marks in `curve_figures`."""
    marks = f"bars are {CONFIDENCE:.0%} intervals"
    if any(len(curve.runs) > 1 for curve in curves):
        marks = "the mean over training seeds; thin lines are the seeds"
    return f"Validation success by round; {marks}. Wall-clock is collecting and fitting, without validating."


def start_map(episodes: Sequence[EpisodeResult]) -> tuple[Figure, ...]:
    """Draw a top view of where the object starts in solved and failed episodes; no figure if the starts are unknown."""
    known = [(one.success, one.start) for one in episodes if one.start]
    if not known:
        return ()
    with drawing(1, size=(_PANEL[0], 4.6)) as (drawn, axes):
        axis = axes[0, 0]
        for success, name, marker, colour in ((True, "solved", ".", BASELINE), (False, "failed", "x", CLONING)):
            starts = [start[:2] for outcome, start in known if outcome == success]
            axis.plot(*np.reshape(starts, (-1, 2)).T, marker, color=colour, ms=5, label=name)
        axis.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        drawn.legend(loc="outside lower left")
        return (to_figure(drawn, "Starts of solved and failed episodes, seen from above"),)
