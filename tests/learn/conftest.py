from __future__ import annotations

import numpy as np
import pytest
import torch

from manip_il.data.schema import RobotTaskSpec
from manip_il.learn.threads import threads

N, K, EPISODES, LENGTH = 4, 6, 12, 20


@pytest.fixture(autouse=True)
def _one_thread():
    with threads(1):
        yield


@pytest.fixture
def spec() -> RobotTaskSpec:
    return RobotTaskSpec(
        robot="arm",
        task="reach",
        fps=25,
        joint_names=("a", "b", "c", "gripper"),
        environment_state_names=tuple(f"e{i}" for i in range(K)),
        sim_state_size=9,
        instruction="reach",
    )


def make_table(seed: int = 0) -> dict[str, np.ndarray]:
    """A smooth expert over random states; `e2` never moves."""
    rng = np.random.default_rng(seed)
    rows = EPISODES * LENGTH
    state = rng.normal(size=(rows, N)) * 0.3 + 1.0
    environment = rng.normal(size=(rows, K)) * 0.1
    environment[:, 2] = 0.4
    action = state + 0.05 * np.tanh(environment[:, :N] * 10.0 - state)
    action[:, -1] = np.where(environment[:, 0] > 0, 0.04, 0.0)
    return {
        "observation.state": state.astype(np.float32),
        "observation.environment_state": environment.astype(np.float32),
        "action": action.astype(np.float32),
        "label_valid": np.ones((rows, 1), np.int64),
        "episode_index": np.repeat(np.arange(EPISODES), LENGTH),
        "frame_index": np.tile(np.arange(LENGTH), EPISODES),
    }


@pytest.fixture
def table() -> dict[str, np.ndarray]:
    return make_table()


@pytest.fixture
def weights():
    """The tensors of a `pretrained_model` folder."""
    from safetensors.torch import load_file

    def read(path) -> dict[str, torch.Tensor]:
        return load_file(path / "model.safetensors")

    return read
