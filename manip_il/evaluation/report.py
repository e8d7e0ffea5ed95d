"""`report.html`: one file without network access or scripts, rendered from the template beside
this module.

Its parts are tables of text, also for the terminal, films, and figures drawn by matplotlib as SVG.
A figure's panel is as wide as a phone's screen, so that its text stays readable there; wide windows
show panels side by side.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from manip_il.data.atomic import write_file
from manip_il.errors import printable

INTERVAL = "[95 % interval]"  # part of a column's header; see `CONFIDENCE`
# after Okabe and Ito's palette, distinguishable with every kind of colour blindness
DAGGER = "#0072b2"
CLONING = "#d55e00"
_PLAIN_WIDTH = 240  # files and pipes have no width to wrap lines at
INK = "#1d2126"
SOFT = "#5b636d"
RULE = "#e3e5e8"
COLOURS = (DAGGER, CLONING, "#00835f", "#a6408a", "#9a6f00", "#2f8fc4", "#7a4a2b")
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
def drawing(columns: int, *, size: tuple[float, float]) -> Iterator[tuple[Any, Any]]:
    """Yield a figure and its axes in the reports' style.

    Args:
        columns: Number of panels side by side.
        size: Width and height of one panel [inches].

    Yields:
        The figure, and its axes as an array (1, columns).
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure as Drawn

    with mpl.rc_context(_STYLE):
        drawn = Drawn((size[0] * columns, size[1]), layout="constrained")
        yield drawn, drawn.subplots(1, columns, squeeze=False)


def to_figure(drawn: Any, words: str) -> Figure:
    """Return a drawn figure as part of a report; call it inside `with drawing(...)`."""
    content = io.BytesIO()
    drawn.savefig(content, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    return Figure(content.getvalue(), words, round(_DPI * drawn.get_figwidth()))


@dataclass(frozen=True)
class Table:
    """Columns and rows of text; an empty cell means not measured.

    Attributes:
        columns: The headers; the first column names the row.
        rows: The cells of each row, as many as there are columns.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def filled(self) -> Table:
        """Return the table without its empty columns."""
        keep = [i for i in range(len(self.columns)) if i == 0 or any(row[i] for row in self.rows)]
        rows = tuple(tuple(row[i] for i in keep) for row in self.rows)
        return Table(tuple(self.columns[i] for i in keep), rows)

    def print(self) -> None:
        """Print the non-empty columns as plain text."""
        console = Console(highlight=False)
        if not console.is_terminal:
            console.width = _PLAIN_WIDTH
        table = self.filled()
        drawn = RichTable(box=box.ASCII2, pad_edge=False)
        for index, name in enumerate(table.columns):
            drawn.add_column(Text(name), justify="right" if index else "left")
        for row in table.rows:
            # Text objects, because Rich would parse the brackets of an interval as markup
            drawn.add_row(*(Text(printable(cell or "-")) for cell in row))
        console.print(drawn)


REPORT_FILE = "report.html"


@dataclass(frozen=True)
class Film:
    """One episode as a film.

    Attributes:
        title: Shown in bold before the caption.
        mp4: Content of the MP4 file (H.264).
        caption: Text below the film.
    """

    title: str
    mp4: bytes
    caption: str = ""


@dataclass(frozen=True)
class Section:
    """A part of a report; what is empty is omitted.

    Attributes:
        heading: Its title.
        lead: Paragraphs below the title.
        formulas: One formula per line.
        figures: The figures.
        tables: The tables.
        notes: Paragraphs below the tables.
        films: The films.
    """

    heading: str
    lead: tuple[str, ...] = ()
    formulas: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    tables: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()
    films: tuple[Film, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Report:
    """A page of results, with how they were made.

    Attributes:
        title: The page's title.
        verdict: The first sentence, with numbers.
        sections: The parts of the page.
        facts: Further facts, one sentence each.
        command: The command line that made the page, which the command fills in.
        config: The command's options, which the command fills in.
        fingerprint: The environment's fingerprint, a nested mapping.
    """

    title: str
    verdict: str
    sections: tuple[Section, ...]
    facts: tuple[str, ...] = ()
    command: str = ""
    config: Mapping[str, Any] = field(default_factory=dict[str, Any])
    fingerprint: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def render(self) -> str:
        """Return the page as one string of HTML."""
        environment = Environment(
            loader=PackageLoader("manip_il.evaluation"),
            autoescape=True,
            trim_blocks=True,
            lstrip_blocks=True,
            undefined=StrictUndefined,
        )
        filters: dict[str, Any] = environment.filters
        filters["base64"] = lambda content: base64.b64encode(content).decode("ascii")
        filters["yaml"] = lambda tree: yaml.safe_dump(
            dict(tree), sort_keys=False, allow_unicode=True
        )
        return environment.get_template("report.html.j2").render(report=self)

    def write(self, folder: Path) -> Path:
        """Write `report.html` atomically, creating its folder; return its path."""
        path = folder / REPORT_FILE
        write_file(path, self.render().encode())
        return path
