"""The terminal's table shows the same numbers, and no control characters where nobody is watching."""

import io

import pytest
from rich.console import Console

from manip_il.evaluation.report_data import PolicyRow
from manip_il.evaluation.statistics import Proportion
from manip_il.evaluation.terminal import print_results

ROWS = [
    PolicyRow("Expert", Proportion(199, 200), kind="expert"),
    PolicyRow("BC [mlp]", Proportion(171, 200), 1234, Proportion(160, 200), 70.5, kind="cloning"),
]


def printed(terminal: bool, width: int = 140) -> str:
    file = io.StringIO()
    print_results(ROWS, Console(file=file, force_terminal=terminal, width=width, highlight=False, color_system="256"))
    return file.getvalue()


def test_a_pipe_gets_plain_lines_one_a_policy():
    lines = printed(terminal=False, width=40).splitlines()
    assert "\x1b" not in "".join(lines)
    line = next(line for line in lines if "BC [mlp]" in line)
    assert str(ROWS[1].success) in line
    assert "1,234" in line
    assert "70.5" in line


@pytest.mark.parametrize("width", [80, 140])
def test_a_terminal_gets_colour_and_whole_numbers(width: int):
    out = printed(terminal=True, width=width)
    assert "\x1b[" in out
    assert "85.5 %" in out
    assert "[80.0, 89.7]" in out


def test_columns_without_a_number_are_left_out():
    assert "disturbed" not in printed(terminal=False)
