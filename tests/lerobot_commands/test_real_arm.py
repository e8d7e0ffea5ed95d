"""A simulated SO-101 and the real one in LeRobot's commands: one dataset of both, and a policy
of ours on its arm.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.rollout.inference.sync import SyncInferenceEngine
from lerobot.utils.constants import OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame

from manip_il.bridges.doctor.examine import examine_folder
from manip_il.cli.main import main
from manip_il.data.dataset import Dataset
from manip_il.data.schema import ACTION, STATE
from manip_il.learn.policy import LearnedPolicy
from manip_il.robots.table import get_robot
from manip_il.worlds.ladder.world import scene_of

from ..so_follower import Camera, arm, record, recorders_features

pytestmark = [pytest.mark.slow, pytest.mark.gl]  # records pictures
HEIGHT, WIDTH = 48, 64
# its recorder has this codec, and merges one codec only
AS_LEROBOT = "--dataset.rgb_encoder.vcodec=libsvtav1"
KEPT = {ACTION, STATE, "observation.images.front"}


@pytest.fixture
def real(monkeypatch: pytest.MonkeyPatch) -> Any:
    robot, model = get_robot("so101"), scene_of("so101", "reach").model
    limits = {
        name: tuple(model.joint(f"robot/{name}").range) for name in (*robot.joints, "gripper")
    }
    found = arm(monkeypatch, limits, {"front": Camera(HEIGHT, WIDTH)})
    found.bus.stand({**dict(zip(robot.joints, robot.home, strict=True)), "gripper": 0.5})
    return found


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("simulated") / "simulated"
    words = [
        "--robot.type=so101",
        "--task.type=reach",
        "--cameras=front",
        "--dataset.num_episodes=2",
        "--workers=1",
    ]
    words += [
        f"--image.height={HEIGHT}",
        f"--image.width={WIDTH}",
        f"--dataset.root={root}",
        AS_LEROBOT,
    ]
    assert main(["record", *words]) == 0
    return root


def without_our_columns(command: Any, root: Path, target: Path) -> Path:
    info = json.loads((root / "meta/info.json").read_text())
    own = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
    ours = [key for key in info["features"] if key not in KEPT | own]
    words = [
        "--repo_id=someone/simulated",
        f"--root={root}",
        "--new_repo_id=someone/plain",
        f"--new_root={target}",
    ]
    words += ["--operation.type=remove_feature", f"--operation.feature_names={ours}"]
    command("lerobot-edit-dataset", *words)
    return target


def test_simulated_and_real_demonstrations_merge_and_train(
    command, real, simulated, act_words, tmp_path
):
    record(real, tmp_path / "real", steps=20, episodes=2, task="Move the hand to the marker")
    plain = without_our_columns(command, simulated, tmp_path / "plain")
    roots = f"--operation.roots=['{plain}','{tmp_path / 'real'}']"
    both = tmp_path / "both"
    words = [
        "--operation.repo_ids=['someone/plain','someone/real']",
        roots,
        "--operation.type=merge",
    ]
    command("lerobot-edit-dataset", "--new_repo_id=someone/both", f"--new_root={both}", *words)

    assert not [one for one in examine_folder(both) if one.is_error]
    info = json.loads((both / "meta/info.json").read_text())
    assert (info["robot_type"], info["fps"], info["total_episodes"]) == ("so_follower", 30, 4)
    merged, first = (
        Dataset.open(both).columns([STATE, ACTION]),
        Dataset.open(simulated).columns([STATE, ACTION]),
    )
    for key in (STATE, ACTION):
        np.testing.assert_array_equal(merged[key][: len(first[key])], first[key])
        assert merged[key].shape == (len(first[key]) + 40, 6)
    assert (
        np.abs(merged[STATE][-1] - np.array(list(real.get_observation().values())[:6])).max() < 1e-4
    )
    read: Any = LeRobotDataset("someone/both", root=both, video_backend="pyav")
    assert read[len(read) - 1]["observation.images.front"].shape == (3, HEIGHT, WIDTH)
    command("lerobot-train", *act_words(both, tmp_path / "run", steps=2), "--batch_size=4")


@pytest.mark.parametrize("policy", ["act", "cnn"])
def test_a_policy_of_ours_drives_the_real_arm_as_lerobot_rollout_asks_it(
    real, simulated, small_act, policy, tmp_path
):
    own = [
        f"--policy.{name}={value}"
        for name, value in (small_act if policy == "act" else {"type": "cnn"}).items()
    ]
    words = [*own, "--observation=images", "--steps=2", "--batch_size=4"]
    assert (
        main(["train", f"--dataset.root={simulated}", *words, f"--output_dir={tmp_path / 'run'}"])
        == 0
    )
    path = tmp_path / "run/checkpoints/last/pretrained_model"

    config = PreTrainedConfig.from_pretrained(path)
    before, after = make_pre_post_processors(config, pretrained_path=str(path))
    features, keys = recorders_features(real), list(real.action_features)
    learnt = get_policy_class(config.type).from_pretrained(path, config=config)
    engine = SyncInferenceEngine(
        learnt, before, after, features, keys, "Move the hand", "cpu", real.name
    )
    engine.reset()
    rng = np.random.default_rng(0)
    real.cameras["front"].picture = rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    observed = real.get_observation()
    action = engine.get_action(build_dataset_frame(features, observed, prefix=OBS_STR))
    assert action is not None

    state = np.array([[observed[name] for name in keys]], np.float32)
    ours = LearnedPolicy.load(path)
    ours.begin({0: ""})
    wanted = ours.act(
        state, np.empty((1, 0), np.float32), {"front": real.cameras["front"].picture[None]}, [0]
    )[0]
    np.testing.assert_allclose(action.numpy(), wanted, atol=1e-3)
    sent = real.send_action(dict(zip(keys, action.tolist(), strict=True)))
    assert list(sent) == keys
    assert torch.isfinite(action).all()
