"""Arms of a study that begin alike begin with the same files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from manip_il.cli.common_options import TaskGroup
from manip_il.cli.dagger import METRICS_FILE, DaggerOptions
from manip_il.cli.outputs import read_jsonl
from manip_il.cli.study import ROUND_0, same_start, share_start
from manip_il.data.lerobot_io import read_tables


@pytest.fixture
def options(tmp_path: Path) -> DaggerOptions:
    return DaggerOptions(
        task=TaskGroup("reach"),
        demonstrations=2,
        rounds=1,
        episodes_per_round=2,
        policy={"width": 16},
        steps=20,
        validation_episodes=2,
        output_dir=tmp_path / "first",
        workers=1,
    )


def bytes_of(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file() and path.suffix in (".safetensors", ".parquet")]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.parametrize("changes", [{"method": "cloning"}, {"label": "takeover"}, {"refit": "warm"}, {"rounds": 9}])
def test_what_differs_after_the_first_round_begins_alike(options, changes):
    assert same_start(options, replace(options, **changes))


@pytest.mark.parametrize("changes", [{"seed": 1}, {"steps": 21}, {"policy": {}}, {"label_budget": 9}, {"ensemble": 2}])
def test_what_differs_from_the_start_does_not(options, changes):
    assert not same_start(options, replace(options, **changes))


@pytest.mark.slow
def test_a_shared_start_ends_with_the_same_bytes_and_is_charged_for_it(options, tmp_path):
    options.run()
    arm = replace(options, method="cloning", output_dir=tmp_path / "shared")
    alone = replace(arm, output_dir=tmp_path / "alone")
    alone.run()
    assert share_start(arm, [replace(options, seed=3), options])
    assert bytes_of(arm.output_dir / ROUND_0) == bytes_of(alone.output_dir / ROUND_0)
    replace(arm, resume=True).run()
    for part in (ROUND_0, "round_001"):
        assert bytes_of(arm.output_dir / part) == bytes_of(alone.output_dir / part)
    rounds = [read_jsonl(run.output_dir / METRICS_FILE) for run in (options, arm)]
    assert rounds[0][0] == rounds[1][0]
    assert len(rounds[1]) == 2
    assert set(read_tables([arm.output_dir / "dataset"], ("actor",))["actor"].ravel()) == {0}


def test_a_run_that_is_there_is_left_alone_and_so_is_one_without_a_twin(options, tmp_path):
    assert not share_start(options, [replace(options, output_dir=tmp_path / "nowhere")])
    assert not options.output_dir.exists()
    options.output_dir.mkdir()
    assert not share_start(options, [options])
