from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_write import write_dataset
from manip_il.data.schema import features
from manip_il.learn.checkpoint import Origin
from manip_il.learn.network import threads
from manip_il.mdp import Episode
from manip_il.worlds.contract import EnvironmentSpec

N, K, EPISODES, LENGTH = 4, 6, 12, 20
Table = dict[str, np.ndarray]


@pytest.fixture(autouse=True)
def _one_thread():
    with threads(1):
        yield


@pytest.fixture(scope="session")
def spec() -> EnvironmentSpec:
    return EnvironmentSpec(
        robot="arm",
        task="reach",
        fps=25,
        joint_names=("a", "b", "c", "gripper"),
        environment_state_names=tuple(f"e{i}" for i in range(K)),
        sim_state_size=9,
        instruction="reach",
    )


@pytest.fixture
def pictured(spec) -> EnvironmentSpec:
    return replace(spec, cameras=("front", "wrist"), image_size=(32, 48), video=False)


def make_table(seed: int = 0) -> Table:
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
    }


@pytest.fixture
def table() -> Table:
    return make_table()


@pytest.fixture
def gapped(table) -> Table:
    """The table with a tenth of its labels invalid."""
    table["label_valid"][::10] = 0
    return table


def write_table(
    table: Mapping[str, np.ndarray], root: Path, spec: EnvironmentSpec
) -> tuple[Dataset, ...]:
    """A dataset on disk, what the table lacks being zeros, pictures noise."""
    rng = np.random.default_rng(0)
    episodes = []
    for number in np.unique(table["episode_index"]):
        rows = table["episode_index"] == number
        columns: dict[str, Any] = {}
        for key, feature in features(spec).items():
            shape = (int(rows.sum()), *feature["shape"])
            if feature["dtype"] in ("image", "video"):
                columns[key] = rng.integers(256, size=shape, dtype=np.uint8)
            else:
                values = table[key][rows] if key in table else np.zeros(shape)
                columns[key] = values.reshape(shape).astype(feature["dtype"])
        episodes.append(Episode(int(number), columns, success=True, success_at_end=True))
    write_dataset(episodes, root, spec, fingerprint={"mujoco": "3.11"})
    return (Dataset.open(root),)


@pytest.fixture
def write(tmp_path, spec):
    """Writes a table as a dataset, by a name."""
    return lambda table, name="data", spec=spec: write_table(table, tmp_path / name, spec)


@pytest.fixture(scope="session")
def dataset(spec, tmp_path_factory) -> tuple[Dataset, ...]:
    """The table with a tenth of its labels invalid, on disk."""
    table = make_table()
    table["label_valid"][::10] = 0
    return write_table(table, tmp_path_factory.mktemp("lerobot") / "dataset", spec)


@pytest.fixture
def act(spec, tmp_path) -> Path:
    """A checkpoint of LeRobot's `act`."""
    from .tiny_policies import write_checkpoint

    return write_checkpoint(tmp_path / "policy", "act", spec, origin=Origin.of(spec))


def read(path: Path) -> dict[str, torch.Tensor]:
    """The tensors of a `pretrained_model` folder."""
    from safetensors.torch import load_file

    return load_file(path / "model.safetensors")


@pytest.fixture
def weights():
    """The tensors of a `pretrained_model` folder."""
    return read
