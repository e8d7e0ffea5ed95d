"""A table as text, once: on a terminal, in Markdown, on a page."""

from __future__ import annotations

from dataclasses import dataclass

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from manip_il.errors import ManipError

PLAIN_WIDTH = 240  # a file or a pipe has no width to fold lines at


@dataclass(frozen=True)
class Cells:
    """Columns and rows of text; an empty cell is one that was not measured. The first column names the row."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ManipError(f"a table's row has {len(row)} cells, its head {len(self.columns)}: {row}")

    def filled(self) -> Cells:
        """Without the columns that no row fills."""
        keep = [i for i in range(len(self.columns)) if i == 0 or any(row[i] for row in self.rows)]
        return Cells(tuple(self.columns[i] for i in keep), tuple(tuple(row[i] for i in keep) for row in self.rows))

    def markdown(self) -> str:
        """As GitHub renders it, numbers to the right."""
        rule = ("---", *("--:" for _ in self.columns[1:]))
        lines = [
            "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in (self.columns, *self.rows)
        ]
        return "\n".join([lines[0], "|" + "|".join(rule) + "|", *lines[1:]]) + "\n"


def print_table(cells: Cells, console: Console | None = None) -> None:
    """Print to standard output, without the columns that no row fills: plain text where nobody is watching."""
    console = console or Console(highlight=False)
    if not console.is_terminal:
        console = Console(file=console.file, width=PLAIN_WIDTH, color_system=None, highlight=False)
    cells = cells.filled()
    table = Table(box=box.SIMPLE_HEAD if console.is_terminal else box.ASCII2, pad_edge=False)
    for index, name in enumerate(cells.columns):
        table.add_column(Text(name), justify="right" if index else "left")
    for row in cells.rows:
        table.add_row(*map(Text, row))  # Text, as Rich would take the brackets of an interval for markup
    console.print(table)
