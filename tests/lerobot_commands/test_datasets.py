"""LeRobot's commands about datasets, on one that we recorded."""

from __future__ import annotations

import numpy as np
import pytest

from manip_il.data.dataset import Dataset
from manip_il.doctor.examine import examine_folder, has_errors

pytestmark = pytest.mark.slow


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
