"""LeRobot's commands about datasets, on one that we recorded."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from manip_il.data.dataset import Dataset
from manip_il.doctor.examine import examine_folder, has_errors

pytestmark = pytest.mark.slow
REPO = "--repo_id=someone/seen"


@pytest.fixture(scope="module")
def seen(record):
    return record("seen", 3, "--cameras=front", "--image.height=32", "--image.width=32")


@pytest.mark.gl  # records pictures
def test_lerobot_dataset_viz_saves_an_episode_for_rerun(command, seen, tmp_path):
    words = ["--repo-id=someone/seen", f"--root={seen}", "--episode-index=1", "--save=1", f"--output-dir={tmp_path}"]
    command("lerobot-dataset-viz", *words)
    (recording,) = tmp_path.glob("*.rrd")
    data = recording.read_bytes()
    for entity in ("observation.images.front", "action", "state", "next.reward"):
        assert entity.encode() in data, entity


@pytest.mark.gl
def test_lerobot_edit_dataset_removes_a_feature_and_tells_what_is_left(command, seen, tmp_path):
    root = tmp_path / "kept"
    feature = ["--operation.type=remove_feature", "--operation.feature_names=['observation.images.front']"]
    command(
        "lerobot-edit-dataset", REPO, f"--root={seen}", "--new_repo_id=someone/kept", f"--new_root={root}", *feature
    )
    assert not has_errors(examine_folder(root))
    for key in ("action", "observation.environment_state", "sim_state", "seed"):
        np.testing.assert_array_equal(Dataset.open(root).columns([key])[key], Dataset.open(seen).columns([key])[key])
    words = ["--operation.type=info", "--operation.show_features=true"]
    said = command("lerobot-edit-dataset", "--repo_id=someone/kept", f"--root={root}", *words)
    assert "observation.environment_state" in said
    assert "observation.images.front" not in said


@pytest.mark.gl
def test_lerobot_edit_dataset_recomputes_the_statistics_that_we_wrote(command, seen, tmp_path):
    root = tmp_path / "again"
    shutil.copytree(seen, root)
    before = json.loads((root / "meta/stats.json").read_text())
    words = [f"--new_root={root}", "--operation.type=recompute_stats", "--operation.overwrite=true"]
    command("lerobot-edit-dataset", REPO, f"--root={root}", *words)
    after = json.loads((root / "meta/stats.json").read_text())
    for key in ("action", "observation.state", "observation.environment_state"):
        for statistic in ("mean", "min", "max"):
            np.testing.assert_allclose(after[key][statistic], before[key][statistic], rtol=1e-5, atol=1e-6)
        # LeRobot sums squares, which loses what varies by less than a thousandth of its size.
        np.testing.assert_allclose(after[key]["std"], before[key]["std"], rtol=1e-3, atol=1e-3)


def test_lerobot_info_names_the_version_that_we_build_on(command):
    said = command("lerobot-info")
    assert "LeRobot version: 0.6.1" in said
    assert "lerobot-eval" in said


def test_lerobot_edit_dataset_merges_varied_worlds_with_plain_ones_and_takes_episodes_out(command, record, tmp_path):
    varied, plain = record("varied", 2, "--vary=dynamics"), record("plain", 2)
    both, rest = tmp_path / "both", tmp_path / "rest"
    sources = ["--operation.repo_ids=['someone/varied','someone/plain']", f"--operation.roots=['{varied}','{plain}']"]
    command(
        "lerobot-edit-dataset", "--new_repo_id=someone/both", f"--new_root={both}", "--operation.type=merge", *sources
    )
    assert not has_errors(examine_folder(both))
    drawn = Dataset.open(varied).episodes.drawn
    assert Dataset.open(both).episodes.drawn == {**drawn, 2: {}, 3: {}}
    assert all(drawn.values())
    taken = ["--operation.type=delete_episodes", "--operation.episode_indices=[0]"]
    words = ["--repo_id=someone/both", f"--root={both}", "--new_repo_id=someone/rest", f"--new_root={rest}", *taken]
    command("lerobot-edit-dataset", *words)
    assert not has_errors(examine_folder(rest))
    assert Dataset.open(rest).episodes.drawn == {}  # its rows have LeRobot's own columns alone
    kept = len(Dataset.open(rest).columns(["sim_state"])["sim_state"])
    np.testing.assert_array_equal(
        Dataset.open(rest).columns()["sim_state"], Dataset.open(both).columns(["sim_state"])["sim_state"][-kept:]
    )
