"""Tables of text, for the terminal and for reports."""

from __future__ import annotations

from dataclasses import dataclass

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from manip_il.errors import printable

INTERVAL = "[95 % interval]"  # part of a column's header; see `CONFIDENCE`
# after Okabe and Ito's palette, distinguishable with every kind of colour blindness
DAGGER = "#0072b2"
CLONING = "#d55e00"
EXPERT = "#00835f"
BASELINE = "#868e98"
_PLAIN_WIDTH = 240  # files and pipes have no width to wrap lines at


@dataclass(frozen=True)
class Table:
    """Columns and rows of text; an empty cell means not measured.

    Attributes:
        columns: The headers; the first column names the row.
        rows: The cells of each row, as many as there are columns.
        colours: One per row, such as `#0072b2`; empty for none.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    colours: tuple[str, ...] = ()

    def filled(self) -> Table:
        """Return the table without its empty columns."""
        keep = [i for i in range(len(self.columns)) if i == 0 or any(row[i] for row in self.rows)]
        rows = tuple(tuple(row[i] for i in keep) for row in self.rows)
        return Table(tuple(self.columns[i] for i in keep), rows, self.colours)

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
