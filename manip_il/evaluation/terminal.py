"""The report's table on a terminal; plain lines where nobody is watching."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from manip_il.evaluation.report_data import PolicyRow
from manip_il.evaluation.statistics import Proportion

NOT_MEASURED = "-"
PLAIN_WIDTH = 160  # a file or a pipe has no width to fold lines at
ROOMY = 112  # columns: below it, intervals go under their rates
STYLES = {"expert": "green", "dagger": "bold blue", "cloning": "dark_orange", "baseline": "dim"}


def results_table(rows: Sequence[PolicyRow], color: bool = True, width: int = PLAIN_WIDTH) -> Table:
    """Return a table of policies; columns that no row fills are left out."""
    gap = " " if width >= ROOMY else "\n"
    confidence = f"{100 * rows[0].success.confidence:g} %" if rows else ""
    columns: list[tuple[str, list[str]]] = [
        ("expert labels", [NOT_MEASURED if row.labels is None else f"{row.labels:,}" for row in rows]),
        (f"success [{confidence} interval]", [_cell(row.success, gap) for row in rows]),
        ("success at end", [_cell(row.success_at_end, gap) for row in rows]),
        (
            "steps to success",
            [NOT_MEASURED if r.steps_to_success is None else f"{r.steps_to_success:.1f}" for r in rows],
        ),
        ("success, disturbed", [_cell(row.disturbed, gap) for row in rows]),
    ]
    columns = [column for column in columns if any(cell != NOT_MEASURED for cell in column[1])]
    table = Table(box=box.SIMPLE_HEAD if color else box.ASCII2, header_style="bold" if color else "", pad_edge=False)
    table.add_column("policy")
    for name, _ in columns:
        table.add_column(Text(name.replace(" ", gap, 1)), justify="right", no_wrap=True)
    for index, row in enumerate(rows):
        # Text, as Rich would take the brackets of an interval for markup.
        cells = [Text(row.name), *(Text(cells[index]) for _, cells in columns)]
        table.add_row(*cells, style=STYLES[row.kind] if color else "")
    return table


def print_results(rows: Sequence[PolicyRow], console: Console | None = None) -> None:
    """Print the table to standard output: in colour on a terminal, as plain text elsewhere."""
    console = console or Console(highlight=False)
    if console.is_terminal:
        console.print(results_table(rows, width=console.width))
    else:
        plain = Console(file=console.file, width=PLAIN_WIDTH, color_system=None, highlight=False)
        plain.print(results_table(rows, color=False))


def _cell(proportion: Proportion | None, gap: str) -> str:
    return NOT_MEASURED if proportion is None else str(proportion).replace(" [", f"{gap}[")
