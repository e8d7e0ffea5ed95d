"""Tables show the same numbers on a terminal and in a pipe."""

import io

import pytest
from rich.console import Console

from manip_il.evaluation.tables import CLONING, EXPERT, PolicyRow, Table, evaluation_table, policy_table, print_table

from .made_evals import made_eval

ROWS = [
    PolicyRow("Expert", made_eval(fails=lambda *_: False), colour=EXPERT),
    PolicyRow("BC [mlp]", made_eval(), 1234, colour=CLONING),
]


def printed(table: Table, terminal: bool, width: int = 140) -> str:
    file = io.StringIO()
    console = Console(file=file, force_terminal=terminal, width=width, highlight=False, color_system="256")
    print_table(table, console, empty="-")
    return file.getvalue()


def test_a_pipe_gets_plain_lines_one_a_policy_without_empty_columns():
    text = printed(policy_table(ROWS), terminal=False, width=40)
    assert "\x1b" not in text
    line = next(line for line in text.splitlines() if "BC [mlp]" in line)
    for number in (str(ROWS[1].success), "1,234"):
        assert number in line
    assert "disturbed" not in text
    expert = [cell.strip() for cell in text.splitlines()[3].strip("|").split("|")]
    assert expert[:3] == ["Expert", "-", str(ROWS[0].success)]


@pytest.mark.parametrize("width", [80, 140])
def test_a_terminal_gets_colour_and_whole_numbers(width: int):
    out = printed(policy_table(ROWS), terminal=True, width=width)
    assert "\x1b[" in out
    rate, _, interval = str(ROWS[1].success).partition(" [")
    assert rate in out
    assert interval in out


def test_an_evaluation_has_a_row_for_each_condition_after_that_of_all():
    result = made_eval()
    table = evaluation_table(result)
    assert [row[0] for row in table.rows] == ["all conditions", "nominal", "knocked", "sensing"]
    assert table.rows[0][1:4] == ("120", str(result.success), str(result.success_at_end))
    assert table.rows[2][2] == str(result.by_condition["knocked"].success)
    assert len(evaluation_table(made_eval(conditions=("nominal",))).rows) == 1


def test_columns_that_no_row_fills_are_left_out():
    table = Table(("a", "b", "c"), (("x", "", "1"), ("z", "", "2")))
    assert table.filled() == Table(("a", "c"), (("x", "1"), ("z", "2")))
