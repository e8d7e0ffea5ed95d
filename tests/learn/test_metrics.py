"""Lines of metrics are JSON, whatever a fit gives."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from manip_il import checks
from manip_il.cli.outputs import read_jsonl
from manip_il.learn.metrics import json_lines


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_null(tmp_path: Path, value: float) -> None:
    path = tmp_path / "metrics.jsonl"
    with json_lines(path, 0) as write:
        write({"step": 1, "loss": 0.5, "grad_norm": value})
    assert checks.parse_json("a line", path.read_bytes()) == {"step": 1, "loss": 0.5, "grad_norm": None}


def test_a_run_goes_on_from_lines_with_nan(tmp_path: Path) -> None:
    """As earlier versions wrote them."""
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps({"step": step, "grad_norm": math.nan}) + "\n" for step in (1, 2, 3)))
    with json_lines(path, 2) as write:
        write({"step": 3, "grad_norm": 1.0})
    assert read_jsonl(path) == [
        {"step": 1, "grad_norm": None},
        {"step": 2, "grad_norm": None},
        {"step": 3, "grad_norm": 1.0},
    ]
