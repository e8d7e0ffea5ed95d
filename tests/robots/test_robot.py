"""A robot is one YAML beside its model; what is wrong in either is one line."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.errors import UsageError
from manip_il.robots import ROBOTS, reach
from manip_il.robots.ik import ArmIK
from manip_il.robots.reach import Reach
from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_model, arm_spec
from manip_il.robots.table import get_robot
from manip_il.worlds.ladder.world import scene_of
from manip_il.worlds.table import env_fingerprint, make_config

from ..scenes import drive, started, world_at_home
from ..tables import every_robot
from .own import tree_of, write


def refusal(path: Path, task: str = "reach") -> str:
    """The one line that a robot's YAML is refused with."""
    with pytest.raises(UsageError) as caught:
        scene_of(path, task)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_an_arm_from_a_yaml_is_driven_to_the_goal(tmp_path: Path, monkeypatch):
    # solving for its map takes long
    everywhere = Reach(np.array([-1.0, -1.0, 0.0]), np.zeros((41, 41, 21)))
    monkeypatch.setattr(reach, "_solve", lambda robot: everywhere)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    env = started(str(write(tmp_path)), "reach", horizon=60)
    drive(env, 60)
    assert env.solved


def test_an_arm_of_ones_own_is_known_by_what_its_yaml_says(tmp_path: Path):
    trees = {"one": tree_of(), "same": tree_of(), "other": but(home=[0.1, *tree_of()["home"][1:]])}
    for name, tree in trees.items():
        (tmp_path / name).mkdir()
        write(tmp_path / name, tree=tree)
    one, same, other = (
        env_fingerprint(make_config(str(tmp_path / name / "own.yaml"), "reach")) for name in trees
    )
    assert one == same
    assert {key for key in one if one[key] != other[key]} == {"robot_sha256"}


def test_a_copy_of_a_built_in_arm_needs_a_name_of_its_own(tmp_path: Path):
    text = ROBOTS["so101"].read_text()
    (tmp_path / "so101.yaml").write_text(text)
    with pytest.raises(UsageError, match="a built-in robot is called so101; rename the file"):
        get_robot(tmp_path / "so101.yaml")


def but(**changes: Any) -> dict[str, Any]:
    return tree_of() | changes


def inside(part: str, **changes: Any) -> dict[str, Any]:
    return but(**{part: tree_of()[part] | changes})


def without(tree: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in tree.items() if key != name}


MISTAKES = {
    "wrong key": (but(gians=[1]), ["unknown key", "'gians'", "did you mean 'gains'", "gripper"]),
    "too few numbers": (but(home=[0, 0, 0]), ["home has 3 numbers", "expected 5"]),
    "unknown joint": (
        but(joints=["turn", "shoulder", "elbwo", "wrist", "roll"]),
        ["unknown joint", "own", "'elbwo'", "did you mean 'elbow'", "known: elbow, left"],
    ),
    "not a number": (
        but(cameras={"front": {"position": [math.nan, 0, 1], "target": [0, 0, 0]}}),
        ["cameras.front.position.0 is nan", "finite"],
    ),
    "opened the wrong way round": (
        inside("gripper", closed=[0.045] * 2, open=[0.0] * 2),
        ["the fingers stand"],
    ),
    "a package that is not installed": (
        but(model="no_such_arms:arm.xml"),
        ["model is in 'no_such_arms'", "not installed", "pip install --no-deps no-such-arms"],
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_the_yaml_is_one_line(mistake: str, tmp_path: Path):
    tree, words = MISTAKES[mistake]
    path = write(tmp_path, tree=tree)
    line = refusal(path)
    for word in words:
        assert word in line
    # the one where the YAML is read, the other where the model is
    assert str(path) in line or "robot own" in line


def test_nothing_that_belongs_to_a_world_is_left_of_a_model(own: Robot):
    spec = arm_spec(own)
    for kind in ("cameras", "lights", "sensors", "keys", "equalities", "textures"):
        assert list(getattr(spec, kind)) == [], kind
    assert [site.name for site in spec.sites] == ["ee"]
    assert not any(body.mocap for body in spec.bodies)
    assert sorted(motor.name for motor in spec.actuators) == sorted(
        [*own.joints, *own.gripper.joints]
    )
    model = spec.compile()
    assert (model.opt.timestep, model.opt.gravity[2]) == (0.002, -9.81)
    assert [material.name for material in spec.materials] == ["steel"]


@every_robot
def test_at_home_the_hand_points_down_over_the_workspace(robot: str):
    world = world_at_home(robot)
    np.testing.assert_allclose(world.ee.rotation, np.diag([1.0, -1.0, -1.0]), atol=0.05)
    assert np.hypot(*(world.ee.position[:2] - world.scene.robot.workspace.centre)) < 0.06


@every_robot
def test_the_arm_alone_stands_where_the_scenes_arm_does(robot: str):
    world, model, rng = world_at_home(robot), arm_model(get_robot(robot)), np.random.default_rng(0)
    # and no others
    assert [model.joint(i).name for i in range(model.njnt)] == list(world.scene.robot.joints)
    assert model.nu == 0
    alone, home = ArmIK(world.scene.robot), np.asarray(world.scene.robot.home)
    for _ in range(5):
        q = world.data.qpos[world.scene.arm_q] = home + rng.uniform(-0.5, 0.5, len(home))
        world.update()
        for one, other in zip(alone.ee_pose(q), world.ee, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-12)
