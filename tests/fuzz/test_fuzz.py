"""A few inputs of every kind on each run of the tests; `make fuzz` reads thousands, in processes of their own."""

from __future__ import annotations

import faulthandler
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from .table import TARGETS
from .target import Target, bench

INPUTS = 6  # of each target
HANGS = 600  # after so long the process ends, with its stack [s]


@pytest.fixture(autouse=True)
def _alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    faulthandler.dump_traceback_later(HANGS, exit=True, file=sys.__stderr__)
    yield
    faulthandler.cancel_dump_traceback_later()


@pytest.mark.parametrize("target", [pytest.param(target, id=target.name) for target in TARGETS])
def test_mutated_inputs_are_accepted_or_refused_in_one_line(target: Target, tmp_path: Path) -> None:
    with bench(target, tmp_path / "files") as made:
        for number in range(INPUTS):
            tried = made.attempt(made.mutated(0, number), number)
            assert not tried.problem, f"input {number} of {target.name}: {tried.problem}"
