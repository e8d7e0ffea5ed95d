"""What a finding says to do helps: repair, or LeRobot's tool."""

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.compute_stats import compute_episode_stats

from manip_il.bridges.doctor.examine import examine_folder, repair
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.errors import ManipError

from ..damage import DATA, edit_json, edit_table, lines
from ..warm import Warm
from .teaching import make

FRONT = "observation.images.front"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    make(folder / "ours", 3)
    make(folder / "theirs", 2)
    return folder


@pytest.fixture
def ours(made: Path, tmp_path: Path) -> Path:
    """One with cameras."""
    return shutil.copytree(made, tmp_path / "copy") / "ours"


@pytest.fixture
def theirs(made: Path, tmp_path: Path) -> Path:
    """One of LeRobot's."""
    return shutil.copytree(made, tmp_path / "copy") / "theirs"


def mend(root: Path) -> list[str]:
    return list(repair(root))


def test_counts_and_statistics_are_mended_and_the_old_ones_kept(theirs):
    whole = json.loads((theirs / layout.STATS).read_text())
    edit_json(theirs / layout.INFO, lambda info: info.update(total_frames=3, total_episodes=1))
    edit_json(
        theirs / layout.STATS,
        lambda stats: (stats.pop(FRONT), stats[s.ACTION].update(mean=[9] * 5)),
    )
    mend(theirs)
    assert examine_folder(theirs) == []
    stats = json.loads((theirs / layout.STATS).read_text())
    np.testing.assert_allclose(
        stats[s.ACTION]["mean"], whole[s.ACTION]["mean"], rtol=1e-4, atol=1e-6
    )
    np.testing.assert_allclose(stats[FRONT]["mean"], whole[FRONT]["mean"], atol=0.05)
    kept = theirs.with_name("theirs.before-repair")
    assert sorted(path.name for path in kept.iterdir()) == ["info.json", "stats.json"]


def shift(root: Path, mean: float) -> dict[str, list[float]]:
    """Move the actions to a mean, with a deviation of 0.3; return LeRobot's statistics of them."""
    values = (
        np.random.default_rng(0)
        .normal(mean, 0.3, (Dataset.open(root).info.frames, 5))
        .astype(np.float32)
    )
    edit_table(root / DATA, lambda table: table.update({s.ACTION: values.tolist()}))
    found = compute_episode_stats({s.ACTION: values}, {s.ACTION: {"dtype": "float32"}})[s.ACTION]
    return {name: one.tolist() for name, one in found.items()}


def wrong_statistics(root: Path) -> list[str]:
    return [str(one) for one in examine_folder(root) if one.place.startswith(layout.STATS)]


@pytest.mark.parametrize("mean", [2048, 10_000])
def test_a_deviation_that_float32_lost_beside_a_large_mean_is_found_and_computed_again(
    theirs, mean
):
    stats = shift(theirs, mean)
    for std in (stats["std"], [0.0] * 5, [0.6] * 5):
        edit_json(
            theirs / layout.STATS,
            lambda table, std=std: table.update({s.ACTION: stats | {"std": std}}),
        )
        assert [line for line in wrong_statistics(theirs) if f"{s.ACTION}: std is" in line], std
    mend(theirs)
    assert wrong_statistics(theirs) == []
    assert json.loads((theirs / layout.STATS).read_text())[s.ACTION]["std"] == pytest.approx(
        [0.3] * 5, rel=0.1
    )


@pytest.mark.parametrize("mean", [0, 1.5, 90])
def test_statistics_that_lerobot_computed_closely_enough_are_right(theirs, mean):
    stats = shift(theirs, mean)
    edit_json(theirs / layout.STATS, lambda table: table.update({s.ACTION: stats}))
    assert wrong_statistics(theirs) == []


def test_what_a_link_leads_to_is_not_changed(theirs):
    info = theirs / layout.INFO
    elsewhere = info.rename(theirs.with_name("info.json"))
    info.symlink_to(elsewhere)
    edit_json(elsewhere, lambda info: info.update(total_frames=3))
    with pytest.raises(ManipError, match=r"info\.json is a link out of the dataset"):
        mend(theirs)
    assert json.loads(elsewhere.read_text())["total_frames"] == 3


def test_lerobots_tool_deletes_the_episodes_that_a_remedy_names(theirs, warm_lerobot: Warm):
    edit_table(theirs / DATA, lambda table: table[s.ACTION].__setitem__(4, [float("nan")] * 5))
    [finding] = [one for one in examine_folder(theirs) if "not finite" in one.text]
    done = warm_lerobot.run(
        *shlex.split(finding.remedy.partition("delete them: ")[2]), folder=theirs.parent
    )
    assert done.returncode == 0, done.stderr
    assert lines(theirs.with_name("theirs_kept")) == []


def test_no_file_that_is_cut_or_missing_stops_the_examination_or_goes_unseen(ours):
    for path in sorted(path for path in ours.rglob("*") if path.is_file()):
        whole = path.read_bytes()
        for rest in (whole[: len(whole) // 2], None):
            path.unlink()
            if rest is not None:
                path.write_bytes(rest)
            found = lines(ours)
            assert found, path
            assert not any("a check failed" in line for line in found), (path, found)
        path.write_bytes(whole)
