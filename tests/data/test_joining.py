"""Datasets of several tasks become one, equal to what is recorded of these tasks together."""

import numpy as np
import pytest

from manip_il import record
from manip_il.collect.edits import label_states
from manip_il.data.build import merge_datasets
from manip_il.data.dataset import Dataset
from manip_il.errors import MismatchError
from manip_il.mdp import State
from manip_il.sim.config import CameraConfig
from manip_il.worlds.table import make_config, make_env


def test_tasks_are_joined_as_if_recorded_together(tmp_path):
    both = make_config("panda", "reach,lift")
    together = record(tmp_path / "together", both, 2)
    for task, cameras in (("reach", None), ("lift", None), ("press", CameraConfig(("side",), 32))):
        record(tmp_path / task, make_config("panda", task), 1, cameras=cameras)
    merge_datasets([tmp_path / "reach", tmp_path / "lift"], tmp_path / "joined")
    joined = Dataset.open(tmp_path / "joined")
    assert joined.spec == together.spec
    assert joined.fingerprint == together.fingerprint
    assert len(joined.tasks) == 2
    columns = joined.columns()
    states = label_states(both, columns["sim_state"])
    for name, values in states.items():
        assert np.array_equal(values.reshape(-1), columns[name].reshape(-1))
    env = make_env(both)
    for state, around in zip(
        columns["sim_state"], columns["observation.environment_state"], strict=True
    ):
        env.set_state(State.from_vector(state))
        assert np.array_equal(env.observe().environment_state, around)
    with pytest.raises(MismatchError, match="cameras differs"):
        merge_datasets([tmp_path / "reach", tmp_path / "press"], tmp_path / "no")
