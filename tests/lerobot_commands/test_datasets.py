"""LeRobot's commands about datasets, on one that we recorded."""

from __future__ import annotations

import numpy as np
import pytest

from manip_il.data.dataset import Dataset
from manip_il.doctor.examine import examine_folder, has_errors

pytestmark = pytest.mark.slow


@pytest.mark.gl  # records pictures
def test_lerobot_dataset_viz_saves_an_episode_for_rerun(command, record, tmp_path):
    seen = record("seen", 2, "--cameras=front", "--image.height=32", "--image.width=32")
    words = ["--repo-id=someone/seen", f"--root={seen}", "--episode-index=1", "--save=1", f"--output-dir={tmp_path}"]
    command("lerobot-dataset-viz", *words)
    (recording,) = tmp_path.glob("*.rrd")
    data = recording.read_bytes()
    for entity in ("observation.images.front", "action", "state", "next.reward"):
        assert entity.encode() in data, entity


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
        Dataset.open(rest).columns(["sim_state"])["sim_state"],
        Dataset.open(both).columns(["sim_state"])["sim_state"][-kept:],
    )
