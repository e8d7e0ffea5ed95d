"""What a robot's YAML need not say, found on its model."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from manip_il.collect.job import RolloutJob
from manip_il.errors import UsageError
from manip_il.robots.geometry import angle_across, angle_off_vertical
from manip_il.robots.gripper import sweep
from manip_il.robots.ik import ArmIK
from manip_il.robots.robot import FOUND, Robot
from manip_il.robots.table import get_robot, read_robot
from manip_il.seeding import stream_seeds
from manip_il.worlds.table import make_config

from ..scenes import started, still
from .own import ARM, EXAMPLES, JAWS, model_of, tree_of, write

SEEDS = stream_seeds("validation", 4)
every_example = pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)


def short(jaws: str = "slides", **said: Any) -> dict[str, Any]:
    """What the YAML of one's own arm must say, and what it says beside that."""
    tree = {key: value for key, value in tree_of(jaws).items() if key not in (*FOUND, "joints")}
    return tree | {"hand": "hand"} | said


@pytest.fixture(scope="module", params=list(JAWS))
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(
        tmp_path_factory.mktemp("found"), request.param, request.param, short(request.param)
    )


@pytest.fixture(scope="module")
def own(path: Path) -> Robot:
    return get_robot(path)


def test_the_arms_joints_are_those_from_base_to_hand(own: Robot):
    assert list(own.joints) == tree_of()["joints"]


def test_the_frame_is_between_the_tips_with_y_along_their_way(own: Robot):
    said = tree_of()["ee"]
    assert own.ee.body == said["body"]
    np.testing.assert_allclose(own.ee.position, said["position"], atol=0.012)
    np.testing.assert_allclose(np.abs(own.ee.quaternion), np.abs(said["quaternion"]), atol=1e-6)


def test_at_home_the_hand_is_over_the_workspace_and_points_down(own: Robot):
    ik = ArmIK(own)
    position, rotation = ik.ee_pose(np.array(own.home))
    np.testing.assert_allclose(position[:2], own.workspace.centre, atol=0.01)
    assert angle_off_vertical(rotation) < 0.05
    assert abs(np.sin(angle_across(rotation) - ik.ahead(position))) < 0.05
    limited = np.isfinite(ik.limits).all(axis=1)
    margins = np.minimum(np.array(own.home) - ik.limits[:, 0], ik.limits[:, 1] - np.array(own.home))
    assert (margins[limited] > 0.1).all()


def test_gains_suit_the_inertia_that_a_joint_moves(own: Robot):
    shoulder, roll = own.gains[1], own.gains[-1]
    assert shoulder > 2 * roll > 0  # the whole arm hangs on one, the hand on the other
    assert own.forces == (200.0,) * 5  # the model sets no limits


def test_what_is_found_is_the_same_again(own: Robot, path: Path):
    again = read_robot(path)
    assert all(getattr(again, name) == getattr(own, name) for name in FOUND)


def test_what_the_yaml_says_is_not_sought(tmp_path: Path):
    said = {name: tree_of()[name] for name in ("joints", "home", "gains")}
    robot = get_robot(write(tmp_path, tree=short(**said, armature=[0.3] * 5)))
    assert robot.home == tuple(said["home"])
    assert robot.gains == tuple(said["gains"])
    assert robot.armature == (0.3,) * 5


@pytest.mark.parametrize("stance", ['pos="0 0 0.8"', 'euler="0 0 3.14159"'], ids=["high", "turned"])
def test_the_base_that_is_proposed_for_an_arm_out_of_reach_has_the_workspace_within_reach(
    stance: str, tmp_path: Path
):
    model = model_of().replace('<body name="base">', f'<body name="base" {stance}>')
    with pytest.raises(UsageError, match="try base: ") as refused:
        read_robot(write(tmp_path, tree=short(), model=model))
    base = yaml.safe_load(str(refused.value).partition("try base: ")[2])
    assert read_robot(write(tmp_path, tree=short(base=base), model=model)).base == tuple(base)


def test_limits_of_motors_are_those_of_the_model(tmp_path: Path):
    weak = '<motor joint="turn" gear="50" ctrlrange="-1 1" ctrllimited="true"/>'
    model = ARM.replace('<motor name="motor" joint="turn"/>', weak).replace(
        "FINGERS", JAWS["slides"][0]
    )
    assert get_robot(write(tmp_path, tree=short(), model=model)).forces[:2] == (50.0, 200.0)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["reach", "pick_place"])
def test_the_expert_drives_an_arm_of_a_short_yaml(path: Path, task: str):
    episodes = list(RolloutJob(make_config(str(path), task)).run(SEEDS))
    assert all(episode.success for episode in episodes)


@pytest.mark.slow
@every_example
def test_an_example_says_little_and_is_found_whole(example: Path):
    said = [
        line
        for line in example.read_text().splitlines()
        if line.strip() and not line.startswith("#")
    ]
    assert len(said) <= 15
    robot = get_robot(example)
    opens = sweep(robot)
    assert opens.openings[0] < 0.01
    assert opens.openings[-1] > 0.06
    position, rotation = ArmIK(robot).ee_pose(np.array(robot.home))
    np.testing.assert_allclose(position[:2], robot.workspace.centre, atol=0.015)
    assert angle_off_vertical(rotation) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ur5e", "xarm7"])
def test_the_expert_stacks_with_fingers_on_a_linkage(name: str):
    example = next(path for path in EXAMPLES if path.stem == name)
    env = started(str(example), "reach")
    before, linked = env.data.qpos.copy(), sweep(env.scene.robot).linked
    assert linked
    env.advance(still(env, env.world.opening))
    assert np.abs(env.data.qpos - before).max() < 0.01, (
        "all joints of the linkage start where its opening says"
    )
    episodes = list(RolloutJob(make_config(str(example), "stack")).run(SEEDS))
    assert all(episode.success for episode in episodes)
