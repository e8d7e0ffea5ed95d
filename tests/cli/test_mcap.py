"""`manip-il data to-mcap` and `manip-il data from-mcap`, as typed."""

from pathlib import Path

import numpy as np
import pytest

from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_write import write_dataset
from manip_il.worlds.contract import EnvironmentSpec

from .made_runs import make_episode, run

SPEC = EnvironmentSpec("r", "t", 20, ("a", "b"), ("ee.x",), 3, "do it")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("mcap") / "d"
    episodes = [make_episode(SPEC, seed, 4) for seed in range(2)]
    write_dataset(episodes, root, SPEC, fingerprint={})
    return root


@pytest.mark.slow
def test_what_is_exported_is_imported_as_far_as_the_mapping_names_it(dataset, tmp_path, capsys):
    out, mapping = tmp_path / "out", tmp_path / "m.yaml"
    assert run(f"data to-mcap {dataset} {out}") == 0
    assert (out / "mapping.yaml").is_file()
    capsys.readouterr()
    assert run(f"data from-mcap {out} {tmp_path / 'all'} --mapping={out / 'mapping.yaml'}") == 0
    assert capsys.readouterr().out == f"imported 2 episodes, 8 frames to {tmp_path / 'all'}\n"
    feature = (
        "{topic: /action, field: 'joints[name=b].position', dtype: float32, resample: previous,"
        " tolerance: 0.1}"
    )
    mapping.write_text(f"fps: 10\ntask: t\nfeatures:\n  action: {feature}\n")
    assert run(f"data from-mcap {out} {tmp_path / 'new'} --mapping={mapping}") == 0
    assert capsys.readouterr().out.startswith("imported 2 episodes, 4 frames")
    np.testing.assert_array_equal(
        Dataset.open(tmp_path / "new").columns()["action"],
        Dataset.open(dataset).columns()["action"][::2, 1],
    )
