"""Repair: what journals or the data give comes back; what is replaced is kept; the rest is said."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.atomic import exclusive
from manip_il.data.fingerprint import environment_fingerprint
from manip_il.data.journal import Journal
from manip_il.doctor import examine as module
from manip_il.doctor.examine import examine_folder, repair
from manip_il.doctor.patient import Patient
from manip_il.errors import FolderBusyError, ManipError

from ..damage import DATA, cut, digests, edit_json, edit_table, lines

FINGERPRINT = environment_fingerprint(b"", {})


def mend(root: Path) -> list[str]:
    return list(repair(Patient(root), examine_folder(root)))


def test_a_damaged_dataset_is_built_again_and_the_old_one_is_kept(root):
    whole = digests(root)
    cut(root / DATA, 0.5)
    damaged = digests(root)
    said = mend(root)
    assert said == [f"built again from lift.journals: 3 episodes; what was there is kept in {root}.before-repair"]
    assert digests(root) == whole
    assert digests(root.with_name("lift.before-repair")) == damaged
    assert lines(root) == []


def test_a_second_repair_keeps_a_second_copy(root):
    for name in ("lift.before-repair", "lift.before-repair-2"):
        (root / layout.TASKS).unlink()
        mend(root)
        assert root.with_name(name).is_dir()
    assert lines(root) == []


def test_episodes_that_only_the_journals_hold_are_added(root, journals, make_episode, spec):
    Journal(journals, spec, FINGERPRINT).write(make_episode(99))
    mend(root)
    assert json.loads((root / layout.INFO).read_text())["total_episodes"] == 4
    assert lines(root) == []


def test_a_damaged_journal_is_left_out_and_named_where_nothing_better_is_left(root, journals):
    cut(journals / "episode-000000000006.mcap", 0.5)
    (root / DATA).write_bytes(b"")
    said = mend(root)
    assert said[0].startswith("left out: ")
    assert "episode-000000000006.mcap" in said[0]
    assert "2 episodes" in said[1]


def test_journals_that_hold_less_than_the_dataset_replace_nothing(root, journals):
    cut(journals / "episode-000000000006.mcap", 0.5)
    (root / layout.TASKS).unlink()
    before = digests(root)
    said = mend(root)
    assert any("lift.journals makes 2 episodes and the dataset's files still hold 3" in line for line in said)
    assert digests(root) == before
    assert not root.with_name("lift.before-repair").exists()


def test_a_build_that_fails_leaves_everything_as_it_was(root, monkeypatch):
    (root / layout.TASKS).unlink()
    before = digests(root)

    def fails(journals: Path, root: Path) -> None:
        raise ManipError("disk full")

    monkeypatch.setattr(module, "build", fails)
    with pytest.raises(ManipError, match="disk full"):
        mend(root)
    assert digests(root) == before


def test_statistics_are_computed_again(alone):
    whole = json.loads((alone / layout.STATS).read_text())
    edit_json(alone / layout.STATS, lambda stats: stats[s.ACTION].update(mean=[0, 0, 0], q10=[9, 9, 9]))
    wrong = (alone / layout.STATS).read_bytes()
    said = mend(alone)
    assert said[0] == "recomputed from the data: meta/stats.json, 20 columns"
    assert json.loads((alone / layout.STATS).read_text()) == whole
    assert (alone.with_name("lift.before-repair") / layout.STATS).read_bytes() == wrong
    assert lines(alone) == []
    (alone / layout.STATS).unlink()
    mend(alone)
    assert json.loads((alone / layout.STATS).read_text()) == whole


def test_statistics_of_a_matrix_are_those_over_its_last_axis(alone):
    table = pq.read_table(alone / DATA)
    grid = np.random.default_rng(0).normal(size=(20, 2, 3))
    table = table.append_column("grid", pa.array(grid.tolist(), pa.list_(pa.list_(pa.float64()))))
    pq.write_table(table, alone / DATA)
    edit_json(
        alone / layout.INFO,
        lambda info: info["features"].update(grid={"dtype": "float64", "shape": [2, 3], "names": None}),
    )
    (alone / layout.STATS).unlink()
    mend(alone)
    stats = json.loads((alone / layout.STATS).read_text())["grid"]
    np.testing.assert_allclose(stats["mean"], grid.mean(axis=(0, 1)))
    assert stats["count"] == [20]
    assert not any(line.startswith("error") for line in lines(alone))


def test_leftovers_are_moved_and_not_deleted(alone):
    places = ["images/front/episode-000001/frame-000000.png", "data/chunk-000/notes.txt", "../.lift.abc.partial/x"]
    for place in places:
        (alone / place).parent.mkdir(parents=True, exist_ok=True)
        (alone / place).write_bytes(place.encode())
    mend(alone)
    kept = alone.with_name("lift.before-repair")
    for place in places:
        assert not (alone / place).exists()
        assert (kept / place.removeprefix("../")).read_bytes() == place.encode()
    assert lines(alone) == []


def test_what_cannot_be_repaired_is_said(alone):
    edit_table(alone / DATA, lambda table: table[s.ACTION].__setitem__(4, [float("nan")] * 3))
    before = digests(alone)
    reason = "there are no journals in lift.journals to build it from"
    assert mend(alone) == [f"not repaired, as {reason}: data: action"]
    assert digests(alone) == before


def test_a_dataset_that_is_being_written_is_left_alone(root):
    (root / layout.TASKS).unlink()
    with exclusive(root), pytest.raises(FolderBusyError):
        mend(root)
