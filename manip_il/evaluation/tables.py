"""Tables of text, for the terminal and for reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from manip_il.errors import printable
from manip_il.evaluation.intervals import CONFIDENCE
from manip_il.evaluation.results import EvalResult

INTERVAL = f"[{CONFIDENCE:.0%} interval]".replace("%", " %")  # part of a column's header
# after Okabe and Ito's palette, distinguishable with every kind of colour blindness
DAGGER, CLONING, EXPERT, BASELINE = "#0072b2", "#d55e00", "#00835f", "#868e98"
NO_CONDITION = "without a condition"
_PLAIN_WIDTH = 240  # files and pipes have no width to wrap lines at


@dataclass(frozen=True)
class Table:
    """Columns and rows of text; an empty cell means not measured. The first column names the row.

    colours: one per row, such as `#0072b2`; empty for none.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    colours: tuple[str, ...] = ()

    def filled(self) -> Table:
        """Return the table without its empty columns."""
        keep = [i for i in range(len(self.columns)) if i == 0 or any(row[i] for row in self.rows)]
        rows = tuple(tuple(row[i] for i in keep) for row in self.rows)
        return Table(tuple(self.columns[i] for i in keep), rows, self.colours)


def print_table(table: Table) -> None:
    """Print the non-empty columns: in colour on a terminal, else as plain text."""
    console = Console(highlight=False)
    terminal = console.is_terminal
    if not terminal:
        console = Console(file=console.file, width=_PLAIN_WIDTH, color_system=None, highlight=False)
    table = table.filled()
    drawn = RichTable(box=box.SIMPLE_HEAD if terminal else box.ASCII2, pad_edge=False)
    for index, name in enumerate(table.columns):
        drawn.add_column(Text(name), justify="right" if index else "left")
    for index, row in enumerate(table.rows):
        style = table.colours[index] if terminal and table.colours else None
        # Text objects, because Rich would parse the brackets of an interval as markup
        drawn.add_row(*(Text(printable(cell or "-")) for cell in row), style=style)
    console.print(drawn)


@dataclass(frozen=True)
class PolicyRow:
    """One policy's row in the table. labels: number of expert labels that it learnt from, None for the expert itself.

    disturbed: its evaluation under a disturbance, if any.
    """

    name: str
    result: EvalResult
    labels: int | None = None
    disturbed: EvalResult | None = None
    colour: str = DAGGER


def policy_table(rows: Sequence[PolicyRow]) -> Table:
    """Return one row per policy: labels, success, success at the end, steps to success, success when disturbed."""
    cells = tuple(
        (
            row.name,
            "" if row.labels is None else f"{row.labels:,}",
            *_success_cells(row.result),
            str(row.disturbed.success) if row.disturbed else "",
        )
        for row in rows
    )
    columns = ("policy", "expert labels", f"success {INTERVAL}", "success at end", "steps to success")
    return Table((*columns, "success, disturbed"), cells, tuple(row.colour for row in rows))


def evaluation_table(result: EvalResult) -> Table:
    """Return success, success at the end and control steps to success: first over all episodes, then per condition."""
    parts, conditions, colours = {result.policy: result}, result.by_condition, (DAGGER,)
    if len(conditions) > 1:
        parts = {"all conditions": result} | {name or NO_CONDITION: part for name, part in conditions.items()}
        colours = (BASELINE, *[DAGGER] * len(conditions))
    rows = tuple((name, f"{one.success.n:,}", *_success_cells(one)) for name, one in parts.items())
    head = ("condition" if len(rows) > 1 else "policy", "episodes", f"success {INTERVAL}", "success at end")
    return Table((*head, "steps to success"), rows, colours)


def _success_cells(result: EvalResult) -> tuple[str, str, str]:
    steps = result.steps_to_success
    return str(result.success), str(result.success_at_end), "" if steps is None else f"{steps:.1f}"
