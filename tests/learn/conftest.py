from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from manip_il.data.schema import RobotTaskSpec, features
from manip_il.learn.checkpoint import CheckpointMeta
from manip_il.learn.columns import LEARNING_COLUMNS
from manip_il.learn.limits import threads

N, K, EPISODES, LENGTH = 4, 6, 12, 20


@pytest.fixture(autouse=True)
def _one_thread():
    with threads(1):
        yield


@pytest.fixture(scope="session")
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


def make_gapped() -> dict[str, np.ndarray]:
    table = make_table()
    table["label_valid"][::10] = 0
    return table


@pytest.fixture
def gapped() -> dict[str, np.ndarray]:
    """The table with a tenth of its labels invalid."""
    return make_gapped()


@pytest.fixture(scope="session")
def dataset(spec, tmp_path_factory):
    """A LeRobot dataset of the learning columns of the table with a tenth of its labels invalid."""
    from lerobot.datasets import LeRobotDataset

    table, root = make_gapped(), tmp_path_factory.mktemp("lerobot") / "dataset"
    columns = {key: value for key, value in features(spec).items() if key in LEARNING_COLUMNS}
    made = LeRobotDataset.create("manip/test", spec.fps, columns, root=root, use_videos=False)
    for row in range(EPISODES * LENGTH):
        made.add_frame({key: table[key][row] for key in columns} | {"task": spec.instruction})
        if row % LENGTH == LENGTH - 1:
            made.save_episode()
    made.finalize()
    return LeRobotDataset("manip/test", root=root)


@pytest.fixture
def act(spec, tmp_path) -> Path:
    """A checkpoint of LeRobot's `act`."""
    from .tiny_policies import write_checkpoint

    return write_checkpoint(tmp_path / "policy", "act", spec, meta=CheckpointMeta.of(spec))


@pytest.fixture
def pictured(spec) -> RobotTaskSpec:
    return replace(spec, cameras=("front", "wrist"), image_size=(32, 48))


class Curves:
    """Options that ask for TensorBoard and Weights & Biases, and what these left behind."""

    options: ClassVar[dict[str, Any]] = {
        "tensorboard": True,
        "wandb": {"enable": True, "mode": "offline", "disable_artifact": True},
    }

    def steps(self, run: Path) -> list[int]:
        """The steps of the loss in TensorBoard's file, once there is a run of Weights & Biases, too."""
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        assert list((run / "wandb").glob("offline-run-*"))
        events = EventAccumulator(str(run / "tensorboard"))
        events.Reload()
        return [point.step for point in events.Scalars("loss")]


@pytest.fixture
def curves(tmp_path, monkeypatch) -> Curves:
    monkeypatch.setenv("WANDB_DIR", str(tmp_path))
    return Curves()


@pytest.fixture
def weights():
    """The tensors of a `pretrained_model` folder."""
    from safetensors.torch import load_file

    def read(path) -> dict[str, torch.Tensor]:
        return load_file(path / "model.safetensors")

    return read
