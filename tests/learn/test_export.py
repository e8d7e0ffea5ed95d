"""Exported policies act as the checkpoint does, for any number of rows, and say what their
numbers mean.
"""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file

from manip_il.data.dataset import Dataset
from manip_il.data.fingerprint import policy_sha256
from manip_il.data.schema import ENVIRONMENT_STATE, IMAGES, STATE
from manip_il.errors import ManipError
from manip_il.learn import export
from manip_il.learn.checkpoint import Origin
from manip_il.learn.export import TOLERANCE, export_onnx
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.losses import LOSSES
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.train import Trainer
from manip_il.worlds.contract import EnvironmentSpec

from .tiny_policies import write_checkpoint

SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"
SIDES = (48, 64)  # height and width of pictures
Observation = dict[str, NDArray[Any]]


@cache
def sample() -> tuple[EnvironmentSpec, dict[str, NDArray[Any]]]:
    columns = [STATE, ENVIRONMENT_STATE, "action", "label_valid", "episode_index", "frame_index"]
    return Dataset.open(SAMPLE).spec, Dataset.open(SAMPLE).columns(columns)


@pytest.fixture(params=LOSSES)
def mlp(request, tmp_path) -> Path:
    """A few steps of training, so that units, ranges and weights are those of real data."""
    config = FitConfig({"loss": request.param, "width": 64}, steps=20, batch_size=32)
    return Trainer((Dataset.open(SAMPLE),), config, tmp_path / "run").fit()


def write_cnn(
    folder: Path, spec: EnvironmentSpec, observation: str = "images", **options: Any
) -> Path:
    pictured = replace(spec, cameras=("wrist", "front"), image_size=SIDES)
    return write_checkpoint(
        folder,
        "cnn",
        pictured,
        observation,
        origin=Origin.of(pictured, observation=observation),
        **options,
    )


def drawn(spec: EnvironmentSpec, rows: int, pictures: bool = False) -> Observation:
    """Noise, and beside it in every second picture a small bright thing on black, which
    keypoints are sharp on.
    """
    rng = np.random.default_rng(1)
    observation = {
        STATE: rng.normal(size=(rows, len(spec.joint_names))).astype(np.float32),
        ENVIRONMENT_STATE: (
            rng.normal(size=(rows, len(spec.environment_state_names))).astype(np.float32)
        ),
    }
    for camera in ("front", "wrist") if pictures else ():
        picture = rng.integers(256, size=(rows, *SIDES, 3), dtype=np.uint8)
        picture[::2] = 0
        for row in range(0, rows, 2):
            y, x = rng.integers(40, size=2)
            picture[row, y : y + 4, x : x + 4] = rng.integers(256, size=3)
        observation[IMAGES + camera] = picture
    return observation


def lerobot_actions(checkpoint: Path, observation: Observation) -> NDArray[np.float32]:
    """What `select_action` and LeRobot's processors make of observations."""
    policy = get_policy_class(
        json.loads((checkpoint / "config.json").read_text())["type"]
    ).from_pretrained(checkpoint)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(checkpoint))
    batch = {key: torch.from_numpy(values) for key, values in observation.items()}
    for key in batch:
        if key.startswith(IMAGES):
            batch[key] = batch[key].permute(0, 3, 1, 2).contiguous().float() / 255
    with torch.inference_mode():
        return after(policy.select_action(before(batch))).numpy()


def check_equal(checkpoint: Path, observations: list[Observation]) -> None:
    content, _ = export_onnx(checkpoint)
    session = onnxruntime.InferenceSession(content)
    for observation in observations:
        expected = lerobot_actions(checkpoint, observation)
        taken = {one.name: observation[one.name] for one in session.get_inputs()}
        actions = np.asarray(session.run(["action"], taken)[0])
        assert actions.dtype == np.float32
        assert actions.shape == expected.shape
        assert np.abs(actions - expected).max() <= TOLERANCE


def test_an_mlp_acts_as_its_checkpoint_on_real_and_random_observations(mlp):
    spec, table = sample()
    real = {key: table[key].copy() for key in (STATE, ENVIRONMENT_STATE)}
    assert len(real[STATE]) > 300
    check_equal(mlp, [real, drawn(spec, 1), drawn(spec, 130)])


@pytest.mark.parametrize("observation", ["images", "both"])
def test_a_cnn_acts_as_its_checkpoint_whatever_the_number_of_pictures(observation, spec, tmp_path):
    size = 6 if observation == "images" else 0  # what is read off the pictures
    checkpoint = write_cnn(
        tmp_path / "cnn", spec, observation, loss="mixture", privileged_size=size
    )
    check_equal(checkpoint, [drawn(spec, 1, pictures=True), drawn(spec, 21, pictures=True)])


def metadata_in(data: bytes) -> dict[str, Any]:
    told = {one.key: one.value for one in onnx.load_model_from_string(data).metadata_props}
    told |= {key: json.loads(told[key]) for key in ("names", "control_rate_hz")}
    return told


def test_the_metadata_name_every_number(tmp_path):
    spec, _ = sample()
    checkpoint = write_cnn(tmp_path / "cnn", spec, "both")
    data, _ = export_onnx(checkpoint)
    assert metadata_in(data) == {
        "robot": "panda",
        "task": "pick_place",
        "control_rate_hz": 20,
        "action_meaning": "joint position targets [rad], gripper opening command [m]",
        "policy_type": "cnn",
        "policy_loss": "l1",
        "policy_sha256": policy_sha256(checkpoint),
        "names": {
            STATE: [*spec.joint_names],
            ENVIRONMENT_STATE: [*spec.environment_state_names],
            "action": [*spec.joint_names],
        },
    }
    session = onnxruntime.InferenceSession(data)
    assert {one.name: one.shape for one in (*session.get_inputs(), *session.get_outputs())} == {
        STATE: ["batch", 8],
        ENVIRONMENT_STATE: ["batch", len(spec.environment_state_names)],
        f"{IMAGES}front": ["batch", *SIDES, 3],
        f"{IMAGES}wrist": ["batch", *SIDES, 3],
        "action": ["batch", 8],
    }


def test_a_policys_rate_is_that_of_its_data(tmp_path):
    spec = replace(sample()[0], fps=12.5)
    policy = write_checkpoint(tmp_path / "mlp", "mlp", spec, origin=Origin.of(spec))
    assert metadata_in(export_onnx(policy)[0])["control_rate_hz"] == 12.5


def test_a_file_that_acts_otherwise_is_refused(spec, tmp_path, monkeypatch):
    checkpoint = write_checkpoint(tmp_path / "mlp", "mlp", spec)
    other = write_checkpoint(tmp_path / "other", "mlp", spec)
    weights = load_file(other / "model.safetensors")
    weights["model.target_mean"] += 2 * TOLERANCE
    save_file(weights, other / "model.safetensors")
    policy, make = LearnedPolicy.load(other), export.PolicyFunction
    monkeypatch.setattr(export, "PolicyFunction", lambda _: make(policy))
    with pytest.raises(
        ManipError, match=r"differ by up to 2e-05 from the checkpoint's; expected at most 1e-05"
    ):
        export_onnx(checkpoint)
