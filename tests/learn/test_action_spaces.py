"""One dataset is learnt in any action space, and what comes out is joint targets again."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors

from manip_il.data.dataset import Dataset, JoinedDatasets
from manip_il.data.schema import ACTION, STATE
from manip_il.errors import ManipError, MismatchError
from manip_il.learn.action_spaces import Conversion
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.export import export_onnx
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.names import ACTION_SPACES, EE_DELTA, JOINT_DELTA, JOINT_TARGET
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.train import Trainer
from manip_il.robots.ik import ArmIK
from manip_il.robots.table import get_robot
from manip_il.worlds.contract import TWO_ARMS, EnvironmentSpec

from ..tables import every_large_robot, every_robot
from .conftest import write_table
from .tiny_policies import ACT, DIFFUSION

every_space = pytest.mark.parametrize("space", ACTION_SPACES)
SMALL = {"steps": 3, "batch_size": 8, "save_freq": 3, "log_freq": 3}
EPISODES, LENGTH = 3, 12


def moves(robot: str, rows: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Actions and states (rows, n) around the home posture, no step longer than the robot's
    longest.
    """
    the_robot, rng = get_robot(robot), np.random.default_rng(seed)
    limits, longest, home = (
        ArmIK(the_robot).limits,
        the_robot.max_joint_step,
        np.array(the_robot.home),
    )
    joints = np.clip(home + rng.uniform(-0.4, 0.4, (rows, len(home))), limits[:, 0], limits[:, 1])
    targets = np.clip(
        joints + rng.uniform(-longest, longest, joints.shape), limits[:, 0], limits[:, 1]
    )
    openings = rng.uniform(0, 0.08, (2, rows, 1))
    return np.hstack([targets, openings[0]]), np.hstack([joints, openings[1]])


def poses(robot: str, joints: np.ndarray) -> np.ndarray:
    """Position and rotation matrix of `ee`, (rows, 12), of joint values (rows, n)."""
    ik = ArmIK(get_robot(robot))
    return np.array(
        [np.concatenate([part.ravel() for part in ik.ee_pose(row[:-1])]) for row in joints]
    )


@pytest.fixture(scope="module")
def panda() -> EnvironmentSpec:
    return EnvironmentSpec(
        "panda", "reach", 20, get_robot("panda").joint_names, ("e0", "e1"), 5, "reach"
    )


@pytest.fixture(scope="module")
def table() -> dict[str, np.ndarray]:
    rows = EPISODES * LENGTH
    actions, states = moves("panda", rows)
    return {
        STATE: states.astype(np.float32),
        "observation.environment_state": (10 * (actions - states)[:, :2]).astype(np.float32),
        ACTION: actions.astype(np.float32),
        "label_valid": np.ones((rows, 1), np.int64),
        "episode_index": np.repeat(np.arange(EPISODES), LENGTH),
    }


@pytest.fixture(scope="module")
def sources(panda, table, tmp_path_factory) -> tuple[Dataset, ...]:
    return write_table(table, tmp_path_factory.mktemp("spaces") / "dataset", panda)


def trainer_of(
    sources: tuple[Dataset, ...], folder: Path, settings: Any, space: str | None, **more: Any
) -> Trainer:
    config = FitConfig(settings, action_space=space, eval_split=0.0, **SMALL, **more)
    return Trainer(sources, config, folder, resume=folder.is_dir())


@every_robot
@pytest.mark.parametrize("space", [JOINT_TARGET, JOINT_DELTA])
def test_joint_spaces_lose_nothing(robot, space):
    actions, states = moves(robot, 20)
    there = Conversion(space, robot).encode(actions, states)
    np.testing.assert_allclose(
        Conversion(space, robot).decode(there, states), actions, rtol=0, atol=1e-15
    )
    measured = states[:, :-1] if space == JOINT_DELTA else 0.0
    np.testing.assert_array_equal(there[:, :-1], actions[:, :-1] - measured)
    np.testing.assert_array_equal(there[:, -1], actions[:, -1])


@pytest.mark.parametrize("settings", [{"width": 8}, ACT], ids=["mlp", "act"])
def test_both_grippers_of_two_arms_are_absolute(settings, tmp_path):
    names = tuple(f"{side}_{number}" for side in ("left", "right") for number in range(7))
    spec = EnvironmentSpec(
        "aloha", "lift", 50, names, ("e0", "e1"), 5, "lift", action_meaning=TWO_ARMS
    )
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(2, EPISODES * LENGTH, 14)).astype(np.float32)
    episodes = np.repeat(np.arange(EPISODES), LENGTH)
    sources = write_table(
        {
            STATE: states,
            ACTION: actions,
            "episode_index": episodes,
            "label_valid": np.ones((len(states), 1), np.int64),
        },
        tmp_path / "data",
        spec,
    )
    path = trainer_of(sources, tmp_path / "run", settings, JOINT_DELTA).fit()
    found = Checkpoint.open(path)
    targets = Conversion(JOINT_DELTA, grippers=found.grippers).encode(actions, states)
    absolute = (targets == actions).all(axis=0)
    assert (found.grippers, np.flatnonzero(absolute).tolist()) == ((6, 13), [6, 13])


@every_large_robot
def test_a_hand_motion_reaches_the_hands_pose_again_but_not_the_joints(robot):
    actions, states = moves(robot, 20)
    hand = Conversion(EE_DELTA, robot)
    there = hand.encode(actions, states)
    back = hand.decode(there, states)
    np.testing.assert_allclose(poses(robot, back), poses(robot, actions), rtol=0, atol=1e-8)
    np.testing.assert_allclose(hand.encode(back, states), there, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(back[:, -1], actions[:, -1])
    off = np.abs(back - actions)[:, :-1].max()
    assert 1e-3 < off < 4 * get_robot(robot).max_joint_step  # the elbow's part


@every_large_robot
def test_a_hand_motion_is_in_the_worlds_axes_and_a_far_one_is_approached(robot):
    _, states = moves(robot, 1)
    hand, targets = Conversion(EE_DELTA, robot), np.zeros((1, states.shape[1]))
    targets[0, 1] = 0.01
    moved = poses(robot, hand.decode(targets, states)) - poses(robot, states)
    np.testing.assert_allclose(moved[0], [0, 0.01, *[0] * 10], atol=1e-8)
    targets[0, 1] = 10.0
    limits, q = ArmIK(get_robot(robot)).limits, hand.decode(targets, states)[0, :-1]
    assert (np.isfinite(q) & (q >= limits[:, 0]) & (q <= limits[:, 1])).all()


@every_space
def test_the_mlp_learns_each_space_from_the_same_table_and_gives_joint_targets(
    table, sources, tmp_path, space
):
    config = FitConfig(
        {"width": 64, "depth": 2}, action_space=space, steps=600, batch_size=36, eval_split=0.0
    )
    path = Trainer(sources, config, tmp_path).fit()
    policy = LearnedPolicy.load(path)
    assert (policy.checkpoint.space, policy.checkpoint.origin.action_space) == (space, space)
    actions = policy.act(table[STATE], table["observation.environment_state"])
    wanted, states = table[ACTION].astype(np.float64), table[STATE].astype(np.float64)
    reached, needed = (
        poses("panda", actions) - poses("panda", wanted),
        poses("panda", wanted) - poses("panda", states),
    )
    assert np.abs(reached).mean() < 0.2 * np.abs(needed).mean()


@every_space
@pytest.mark.parametrize("settings", [ACT, DIFFUSION], ids=["act", "diffusion"])
def test_lerobots_own_code_carries_each_space(table, sources, tmp_path, space, settings):
    path = trainer_of(sources, tmp_path / "run", settings, space).fit()
    policy = LearnedPolicy.load(path)
    assert (policy.checkpoint.space, policy.checkpoint.origin.action_space) == (space, space)
    config = PreTrainedConfig.from_pretrained(path)
    before, after = make_pre_post_processors(config, str(path))  # as lerobot-eval loads them
    states = torch.from_numpy(table[STATE][:5])
    before(
        {
            STATE: states,
            "observation.environment_state": torch.from_numpy(
                table["observation.environment_state"][:5]
            ),
        }
    )
    found = Conversion(space, "panda")
    learnt = found.encode(table[ACTION], table[STATE])
    middle = after(torch.zeros(5, 8)).numpy()  # of the normalised targets, of whatever kind
    centre = learnt.mean(0) if settings is ACT else (learnt.max(0) + learnt.min(0)) / 2
    np.testing.assert_allclose(
        middle, found.decode(np.tile(centre, (5, 1)), table[STATE][:5]), atol=5e-3
    )
    acted = policy.act(table[STATE][:2], table["observation.environment_state"][:2])
    assert acted.shape == (2, 8)


@pytest.mark.parametrize("space", [JOINT_DELTA, EE_DELTA])
def test_every_action_of_a_plan_is_measured_from_its_own_frame(table, sources, tmp_path, space):
    trainer = trainer_of(sources, tmp_path / "run", ACT, space)
    targets = Conversion(space, "panda").encode(table[ACTION], table[STATE])
    batch = trainer.data.batch(np.array([3, 10]))
    np.testing.assert_array_equal(batch[ACTION][0], targets[3:7])
    np.testing.assert_array_equal(batch[ACTION][1], targets[[10, 11, 11, 11]])  # the episode ends


def test_a_run_in_another_space_goes_on_to_the_same_weights_and_not_in_lerobot_train(
    sources, tmp_path, weights
):
    more = {"observation": "state"}
    whole = trainer_of(sources, tmp_path / "whole", ACT, JOINT_DELTA, **more).fit()

    def stop(_record: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trainer_of(sources, tmp_path / "halves", ACT, JOINT_DELTA, **more).fit(stop)
    halves = trainer_of(sources, tmp_path / "halves", ACT, JOINT_DELTA, **more).fit()
    assert all(torch.equal(value, weights(halves)[name]) for name, value in weights(whole).items())
    before, _ = make_pre_post_processors(PreTrainedConfig.from_pretrained(whole), str(whole))
    with pytest.raises(ManipError, match="continue with manip-il train --resume=true"):
        before({STATE: torch.zeros(2, 8), ACTION: torch.zeros(2, 4, 8)})


def test_a_checkpoint_goes_on_in_its_own_space_alone(table, sources, tmp_path):
    path = Trainer(
        sources, FitConfig({"width": 8}, action_space=EE_DELTA, **SMALL), tmp_path / "ee"
    ).fit()
    more = LearnedPolicy.load(
        trainer_of(sources, tmp_path / "more", {"path": str(path)}, None).fit()
    )
    assert (more.checkpoint.space, more.checkpoint.robot) == (EE_DELTA, "panda")
    assert np.isfinite(more.act(table[STATE], table["observation.environment_state"])).all()
    with pytest.raises(
        MismatchError, match=r"checkpoint .* has ee_delta, this fit has joint_delta"
    ):
        trainer_of(sources, tmp_path / "other", {"path": str(path)}, JOINT_DELTA)
    with pytest.raises(ManipError, match="cannot be exported; train with joint_delta"):
        export_onnx(path)


def test_lerobots_own_training_has_no_kinematics(table, sources):
    [dataset] = sources
    # as LeRobot's
    meta: Any = SimpleNamespace(
        features=JoinedDatasets(sources).features, root=dataset.root, stats={}
    )
    with pytest.raises(ManipError, match="train with manip-il train"):
        make_policy(make_policy_config("mlp", action_space=EE_DELTA), ds_meta=meta)
    policy: Any = make_policy(make_policy_config("mlp", action_space=JOINT_TARGET), ds_meta=meta)
    np.testing.assert_array_equal(policy.model.target_high, table[ACTION].max(0))
