"""The fuzz itself: what counts as a finding, and that its inputs can be made again."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from random import Random

import numpy as np
import pytest
from mcap.records import Metadata

from manip_il.errors import ManipError

from .binary import change_metadata, mutate_npy
from .table import TARGETS
from .target import LARGEST, Bench, Target
from .trees import mutate_json, mutate_yaml


def _bench(tmp_path: Path, read) -> Bench:
    base = tmp_path / "base"
    base.mkdir()
    (base / "file").write_bytes(b"{}")
    return Bench(Target("t", lambda folder: None, "file", mutate_json, (read,)), base, tmp_path / "work")


def test_any_other_error_is_a_finding(tmp_path: Path) -> None:
    tried = _bench(tmp_path, lambda folder: {}["x"]).attempt(b"", 0)
    assert tried.problem.startswith("KeyError: 'x'; ")
    assert "Traceback" in tried.problem


def test_leaving_the_program_is_a_finding(tmp_path: Path) -> None:
    assert _bench(tmp_path, lambda folder: sys.exit(0)).attempt(b"", 0).problem.startswith("SystemExit")


def test_an_error_of_ours_is_no_finding_and_neither_is_a_file_that_may_not_be_read(tmp_path: Path) -> None:
    def refuse(folder: Path) -> None:
        raise ManipError("a\nb")

    tried = _bench(tmp_path, refuse).attempt(b"", 0)
    assert (tried.line, tried.problem) == ("a b", "")
    (tmp_path / "base" / "file").unlink()
    (tmp_path / "base").rmdir()
    tried = _bench(tmp_path, lambda folder: (folder / "absent").read_bytes()).attempt(b"", 0)
    assert "No such file" in tried.line
    assert not tried.problem


@pytest.mark.slow
def test_memory_beyond_the_limit_is_a_finding(tmp_path: Path) -> None:
    tried = _bench(tmp_path, lambda folder: bytes(1) * (LARGEST + 400) * 2**20).attempt(b"", 0)
    assert f"more than {LARGEST}" in tried.problem
    assert tried.megabytes > LARGEST


def test_the_same_number_gives_the_same_input(tmp_path: Path) -> None:
    made = _bench(tmp_path, lambda folder: None)
    assert [made.mutated(0, number) for number in range(9)] == [made.mutated(0, number) for number in range(9)]
    assert len({made.mutated(0, number) for number in range(50)}) > 10


def test_every_valid_tree_can_be_mutated() -> None:
    for number in range(2_000):
        mutate_json(Random(number), b'{"a": [1, 2.5, null, true, "x", {"b": {}}], "c": []}')
    for number in range(300):
        mutate_yaml(Random(number), b"# head\na: [1, 2.5, null, true, x]\nb: {c: d}\n")


def test_what_was_mutated_before_can_be_mutated_again() -> None:
    for number in range(150):
        stream, rng = io.BytesIO(), Random(number)
        np.save(stream, np.arange(12.0).reshape(4, 3))
        array, record = stream.getvalue(), Metadata("x", {"info": '{"a": [1, 2.5, null, true, "x", {"b": {}}]}'})
        for _ in range(4):
            array = mutate_npy(rng, array)
            record = change_metadata(rng, record)


def test_targets_have_names_of_their_own() -> None:
    assert len({target.name for target in TARGETS}) == len(TARGETS)
