"""Records that come back whatever a kill cut short."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.data.atomic import append_line, read_lines
from manip_il.errors import ManipError


def test_records_come_back_in_order(tmp_path):
    path = tmp_path / "m" / "metrics.jsonl"
    assert read_lines(path) == []
    append_line(
        path, {"round": 0, "loss": np.float32(0.5), "path": Path("x"), "rates": np.array([1, 2])}
    )
    append_line(path, {"round": 1})
    assert read_lines(path) == [
        {"round": 0, "loss": 0.5, "path": "x", "rates": [1, 2]},
        {"round": 1},
    ]


@given(cut=st.integers(min_value=0))
def test_a_kill_at_any_byte_costs_at_most_the_last_record(tmp_path_factory, cut):
    path = tmp_path_factory.mktemp("torn") / "metrics.jsonl"
    records = [{"round": i, "note": "é\n"} for i in range(3)]
    for record in records:
        append_line(path, record)
    content = path.read_bytes()
    kept = content[: cut % (len(content) + 1)]
    path.write_bytes(kept)
    before = read_lines(path)
    assert before == records[: len(before)]
    assert len(before) >= kept.count(b"\n")
    append_line(path, {"round": 9})
    assert read_lines(path) == [*before, {"round": 9}]


def test_a_damaged_line_in_the_middle_is_an_error_that_names_it(tmp_path):
    path = tmp_path / "m.jsonl"
    path.write_text('{"a": 1}\nrubbish\n{"a": 2}\n')
    with pytest.raises(ManipError, match="line 2"):
        read_lines(path)


def test_numbers_that_are_not_finite_are_missing(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1, "grad_norm": NaN}\n{"step": 2, "x": [Infinity, -Infinity]}\n')
    append_line(path, {"step": 3, "loss": float("nan")})
    assert "NaN" not in path.read_text().splitlines()[-1]
    assert read_lines(path) == [
        {"step": 1, "grad_norm": None},
        {"step": 2, "x": [None, None]},
        {"step": 3, "loss": None},
    ]
