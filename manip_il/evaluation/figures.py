"""Figures of reports that are more than bars and curves, drawn by matplotlib as SVG in the colours of `report.css`."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

from manip_il.evaluation.report import Report
from manip_il.evaluation.tables import Table

DAGGER, CLONING, EXPERT, SOFT, RULE = "#0072b2", "#d55e00", "#00835f", "#5b636d", "#e3e5e8"
ARMS = (DAGGER, CLONING, EXPERT, "#a6408a", "#9a6f00", "#2f8fc4", "#7a4a2b")
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "path",  # looks the same with whatever fonts a machine has
    "svg.hashsalt": "manip_il",  # the same figure is the same bytes
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # which comes with matplotlib
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
    """A picture of a report. svg: its file; words: what it shows, for who cannot see it."""

    svg: bytes
    words: str


@dataclass(frozen=True)
class Section:
    """A part of a report. Empty parts are left out. formulas: one a line; notes: paragraphs under the table."""

    heading: str
    lead: tuple[str, ...] = ()
    formulas: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    tables: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class SectionsReport(Report):
    """A report of sections, each of words, formulas, figures and tables."""

    template: ClassVar[str] = "sections.html.j2"
    sections: tuple[Section, ...]


@contextmanager
def drawing(
    columns: int, rows: int = 1, size: tuple[float, float] = (3.2, 2.7), *, share: bool = False
) -> Iterator[tuple[Any, Any]]:
    """Yield a figure and its axes (rows, columns) in the reports' style.

    size: of one panel [inches]. share: the panels of a row have the same axes.
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
    """Return a drawn figure as a part of a report; call it while `drawing` is open."""
    content = io.BytesIO()
    drawn.savefig(content, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    return Figure(content.getvalue(), words)
