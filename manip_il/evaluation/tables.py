"""Tables of text, for the terminal, Markdown and reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean, pstdev

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from manip_il.errors import ManipError, printable
from manip_il.evaluation.report_data import PolicyRow
from manip_il.evaluation.results import EvalResult

PLAIN_WIDTH = 240  # a file or a pipe has no width to fold lines at
ROOMY = 112  # columns of a terminal: below it, intervals go under their rates
STYLES = {"expert": "green", "dagger": "bold blue", "cloning": "dark_orange", "baseline": "dim"}
WORST = "\N{BLACK DOWN-POINTING TRIANGLE} "  # begins the cell with the lowest success of a row
NO_CONDITION = "without a condition"
_LONG_NAME = 24  # characters of a row's name, from which on it may be broken over lines


@dataclass(frozen=True)
class Table:
    """Columns and rows of text; an empty cell was not measured. The first column names the row.

    kinds: of the rows, for their colours: CSS classes of a report; empty where rows have none.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    kinds: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ManipError(f"a table's row has {len(row)} cells, its head {len(self.columns)}: {row}")

    @property
    def has_long_names(self) -> bool:
        """Whether a row's name may need to be broken over lines."""
        return any(len(row[0]) > _LONG_NAME for row in self.rows)

    def filled(self) -> Table:
        """Return the table without the columns that no row fills."""
        keep = [i for i in range(len(self.columns)) if i == 0 or any(row[i] for row in self.rows)]
        rows = tuple(tuple(row[i] for i in keep) for row in self.rows)
        return Table(tuple(self.columns[i] for i in keep), rows, self.kinds)

    def markdown(self) -> str:
        """Return the table as GitHub renders it, numbers to the right."""
        rule = ("---", *("--:" for _ in self.columns[1:]))
        rows = (self.columns, *self.rows)
        head, *lines = ("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows)
        return "\n".join([head, "|" + "|".join(rule) + "|", *lines]) + "\n"

    def aligned_lines(self) -> list[str]:
        """Return columns as wide as their widest cell, a rule under the head; all but the first set right."""
        cells = (self.columns, *self.rows)
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in cells]
        return [lines[0].rstrip(), "-" * len(lines[0]), *lines[1:]]


def print_table(table: Table, console: Console | None = None, empty: str = "") -> None:
    """Print the filled columns: in colour on a terminal, as plain text elsewhere. empty: stands for an empty cell."""
    console = console or Console(highlight=False)
    terminal = console.is_terminal
    gap = "\n" if terminal and console.width < ROOMY else " "
    if not terminal:
        console = Console(file=console.file, width=PLAIN_WIDTH, color_system=None, highlight=False)
    table = table.filled()
    drawn = RichTable(box=box.SIMPLE_HEAD if terminal else box.ASCII2, pad_edge=False)
    for index, name in enumerate(table.columns):
        drawn.add_column(Text(name.replace(" ", gap, 1)), justify="right" if index else "left")
    for index, row in enumerate(table.rows):
        style = STYLES.get(table.kinds[index]) if terminal and table.kinds else None
        # Text, as Rich would take the brackets of an interval for markup.
        drawn.add_row(*(Text(printable(cell or empty).replace(" [", f"{gap}[")) for cell in row), style=style)
    console.print(drawn)


def policy_table(rows: Sequence[PolicyRow]) -> Table:
    """Return a row a policy: labels, success, success at the end, steps to success, success under the disturbance."""
    success = f"success [{100 * rows[0].success.confidence:g} % interval]"
    columns = ("policy", "expert labels", success, "success at end", "steps to success", "success, disturbed")
    cells: list[tuple[str, ...]] = []
    for row in rows:
        labels = "" if row.labels is None else f"{row.labels:,}"
        at_end, steps = str(row.success_at_end or ""), _steps(row.steps_to_success)
        cells.append((row.name, labels, str(row.success), at_end, steps, str(row.disturbed or "")))
    return Table(columns, tuple(cells), tuple(row.kind for row in rows))


def evaluation_table(result: EvalResult) -> Table:
    """Return success, success at the end and control steps until success: of all episodes, then of each condition."""
    columns = ("policy", "episodes", f"success [{100 * result.confidence:g} % interval]")
    parts = [(result.policy, result)]
    if len(result.by_condition) > 1:
        parts += [(f"  {name or NO_CONDITION}", part) for name, part in result.by_condition.items()]
    rows = tuple(
        (name, f"{one.success.n:,}", str(one.success), str(one.success_at_end), _steps(one.steps_to_success))
        for name, one in parts
    )
    return Table((*columns, "success at end", "steps to success"), rows)


def _steps(steps: float | None) -> str:
    return "" if steps is None else f"{steps:.1f}"


def evaluation_lines(result: EvalResult) -> list[str]:
    """Return a line that counts failures by phase; none where nothing failed."""
    if not result.failures:
        return []
    phases = ", ".join(f"{phase} {count}" for phase, count in result.failures.items())
    return [f"failures by the phase that they ended in: {phases}"]


def return_line(result: EvalResult) -> str:
    """Return mean and standard deviation of the returns in words."""
    returns = [episode.ret for episode in result.episodes]
    return f"return: {mean(returns):.2f}, standard deviation {pstdev(returns):.2f}"
