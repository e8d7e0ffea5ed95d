"""Figures of reports, drawn by matplotlib as SVG: learning curves.

A panel is as wide as a phone's screen, so that its text stays readable there; wide windows show
panels side by side.
"""

import io
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from manip_il.errors import printable
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.rounds import costs_of
from manip_il.evaluation.side import Side
from manip_il.evaluation.tables import CLONING, DAGGER, EXPERT

INK = "#1d2126"
SOFT = "#5b636d"
RULE = "#e3e5e8"
COLOURS = (DAGGER, CLONING, EXPERT, "#a6408a", "#9a6f00", "#2f8fc4", "#7a4a2b")
_MARKERS = ("o-", "s-", "D-", "^-")  # distinguishable without colour
_PANEL = (4.4, 3.0)  # size of a figure placed beside others [inches]
_DPI = 96
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "path",  # looks the same whatever fonts a machine has
    "svg.hashsalt": "manip_il",  # so that equal figures have equal bytes
    "font.size": 8.5,
    "axes.grid": True,
    "grid.color": RULE,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


@dataclass(frozen=True)
class Figure:
    """A picture in a report.

    Attributes:
        svg: Content of the SVG file.
        words: Alternative text.
        width: Natural width [px].
    """

    svg: bytes
    words: str
    width: int


@contextmanager
def drawing(
    columns: int, rows: int = 1, *, size: tuple[float, float], **options: Any
) -> Iterator[tuple[Any, Any]]:
    """Yield a figure and its axes in the reports' style.

    Args:
        columns: Number of panels side by side.
        rows: Number of panels above each other.
        size: Width and height of one panel [inches].
        options: Further arguments of matplotlib's `Figure.subplots`.

    Yields:
        The figure, and its axes as an array (rows, columns).
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure as Drawn

    with mpl.rc_context(_STYLE):
        drawn = Drawn((size[0] * columns, size[1] * rows), layout="constrained")
        yield drawn, drawn.subplots(rows, columns, squeeze=False, **options)


def to_figure(drawn: Any, words: str) -> Figure:
    """Return a drawn figure as part of a report; call it inside `with drawing(...)`."""
    content = io.BytesIO()
    drawn.savefig(content, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    return Figure(content.getvalue(), words, round(_DPI * drawn.get_figwidth()))


def curve_figures(sides: Sequence[Side], target: float | None = None) -> tuple[Figure, ...]:
    """Draw the validation success of each run of the sides against every cost, one figure each.

    Args:
        sides: The sides.
        target: Success that is drawn as a horizontal line, in [0, 1].
    """
    figures: list[Figure] = []
    for cost in costs_of(run for side in sides for run in side.histories):
        with drawing(1, size=_PANEL) as (drawn, axes):
            axis = axes[0, 0]
            for place, side in enumerate(sides):
                label = printable(textwrap.shorten(side.name, 40)).replace("$", r"\$")
                for run in side.histories:
                    rates = [100 * one.validation.rate for one in run]
                    axis.plot(
                        [one.amount(cost) for one in run],
                        rates,
                        _MARKERS[place % 4],
                        c=side.colour,
                        label=label,
                    )
                    label = ""  # one entry per side in the legend
            if target is not None:
                axis.axhline(
                    100 * target,
                    color=INK,
                    ls="--",
                    lw=1,
                    label=f"target, {format_percent(target)}",
                )
            axis.set(xlabel=cost, ylim=(-2, 102), ylabel="validation success [%]")
            drawn.legend(loc="outside upper left", ncols=2)
            figures.append(
                to_figure(
                    drawn, f"Validation success over {cost}: {', '.join(one.name for one in sides)}"
                )
            )
    return tuple(figures)
