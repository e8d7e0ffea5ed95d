"""A robot is one YAML beside its model; what is wrong in either is one line."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from manip_il.errors import UnknownName, UsageError
from manip_il.robots import reach
from manip_il.robots.ik import ArmIK
from manip_il.robots.reach import Reach
from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_model, arm_spec
from manip_il.robots.table import get_robot
from manip_il.sim.scene import PREFIX
from manip_il.tasks.envs import scene_of

from ..scenes import drive, started, world_at_home
from ..tables import every_robot
from .own import ARM, JAWS, tree_of, write

MODEL = ARM.replace("FINGERS", JAWS["slides"][0])


def refusal(path: Path, task: str = "reach") -> str:
    """The one line that a robot's YAML is refused with."""
    with pytest.raises(UsageError) as caught:
        scene_of(str(path), task)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_an_arm_from_a_yaml_is_a_scene_and_has_the_files_name(tmp_path: Path):
    path = write(tmp_path, "six_axes")
    scene = scene_of(str(path), "reach")
    assert scene.robot.name == "six_axes"
    assert scene.robot.joint_names == ("turn", "shoulder", "elbow", "wrist", "roll", "gripper")
    assert scene.name == "six_axes reach"


def test_an_arm_from_a_yaml_is_driven_to_the_goal(tmp_path: Path, monkeypatch):
    everywhere = Reach(np.array([-1.0, -1.0, 0.0]), np.zeros((41, 41, 21)))  # solving for its map takes long
    monkeypatch.setattr(reach, "_solve", lambda robot: everywhere)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    env = started(str(write(tmp_path)), "reach", horizon=60)
    drive(env, 60)
    assert env.solved


def test_a_yaml_is_found_from_the_current_folder(tmp_path: Path, monkeypatch):
    write(tmp_path, "near")
    monkeypatch.chdir(tmp_path)
    assert get_robot("near.yaml").name == "near"
    assert get_robot("./near.yaml").files.model == tmp_path / "own.xml"


def but(**changes: Any) -> dict[str, Any]:
    return tree_of() | changes


def inside(part: str, **changes: Any) -> dict[str, Any]:
    return but(**{part: tree_of()[part] | changes})


def without(tree: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in tree.items() if key != name}


MISTAKES = {
    "wrong key": (but(gians=[1]), ["unknown key", "'gians'", "did you mean 'gains'", "gripper"]),
    "wrong key inside": (inside("gripper", opne=[1]), ["gripper", "'opne'", "did you mean 'open'"]),
    "the name is the file's": (but(name="mine"), ["unknown key", "'name'"]),
    "missing key": (without(tree_of(), "workspace"), ["has no 'workspace'"]),
    "no hand": (without(tree_of(), "ee"), ["has no 'hand'"]),
    "an unknown yaw": (but(yaw="wrold"), ["unknown yaw", "did you mean 'world'"]),
    "text to mend that is not there": (
        but(mend={"<no>": ""}),
        ["has no text '<no>' to mend", "files that it includes are not mended"],
    ),
    "missing key inside": (but(gripper=without(tree_of()["gripper"], "fingers")), ["gripper is", "`fingers`"]),
    "too few numbers": (but(home=[0, 0, 0]), ["home has 3 numbers", "expected 5"]),
    "too many numbers": (but(gains=[1000] * 6), ["gains has 6 numbers", "expected 5"]),
    "half a position": (inside("ee", position=[0, 0]), ["ee.position has 2 numbers", "expected 3"]),
    "openings for one finger": (inside("gripper", open=[0.04]), ["gripper.open has 1 numbers", "expected 2"]),
    "text for a number": (but(home=[0, "up", 0, 0, 0]), ["home", "'up'", "into a float"]),
    "a number for a list": (but(joints=7), ["joints is 7", "not iterable"]),
    "unknown joint": (
        but(joints=["turn", "shoulder", "elbwo", "wrist", "roll"]),
        ["unknown joint", "own", "'elbwo'", "did you mean 'elbow'", "known: elbow, left"],
    ),
    "unknown gripper joint": (inside("gripper", joints=["left", "rihgt"]), ["'rihgt'", "did you mean 'right'"]),
    "unknown body": (inside("ee", body="hnad"), ["unknown body", "own", "'hnad'", "did you mean 'hand'"]),
    "unknown finger": (inside("gripper", fingers=["left", "rigth"]), ["unknown body", "did you mean 'right'"]),
    "one finger": (inside("gripper", fingers=["left"]), ["gripper.fingers names 1", "expected two or more bodies"]),
    "no way to open": (
        inside("gripper", open=[0.0, 0.04]),
        ["gripper.closed and open are both 0 for joint 'left'"],
    ),
    "opened the wrong way round": (inside("gripper", closed=[0.045] * 2, open=[0.0] * 2), ["the fingers stand"]),
    "hardly opened": (
        inside("gripper", open=[0.001] * 2),
        ["the fingers stand", "gripper.closed, gripper.open and gripper.fingers"],
    ),
    "a gripper's joint among the arm's": (
        but(joints=["turn", "shoulder", "elbow", "wrist", "left"]),
        ["'left'", "joints", "gripper.joints"],
    ),
    "a fixed joint of the arm's": (but(fixed={"elbow": 1.0}), ["'fixed' of robot own", "'elbow'"]),
    "a fixed joint that is none": (but(fixed={"torso": 1.0}), ["'fixed' of robot own", "'torso'"]),
    "a fixed place that is none": (but(fixed={"torso": "up"}), ["fixed is", "'up' into a float"]),
    "a frame that the joints do not move": (
        inside("ee", body="tower"),
        ["joint 'shoulder' does not move 'ee'", "'tower'", "those that do: turn"],
    ),
    "a home in the table": (but(home=[0, 1.6, 1.0, 1.0, 0]), ["at home 'fore' and 'table' overlap by"]),
    "a home in itself": (but(home=[0, -1.4, 2.8, 2.7, 0]), ["at home 'fore' and 'hand' overlap by"]),
    "a home beyond a limit": (but(home=[0, 3.6, 1.0, 1.0, 0]), ["home has 3.6 for joint 'shoulder'", "-1.5 to 2.2"]),
    "a gripper's joint that moves the hand": (
        but(
            **{name: tree_of()[name][:4] for name in ("joints", "home", "gains")},
            gripper=tree_of()["gripper"] | {"joints": ["roll"], "closed": [0.0], "open": [0.5]},
        ),
        ["'roll' of gripper.joints moves the whole hand, 'hand'"],
    ),
    "a step that is a leap": (but(max_joint_step=3), ["max_joint_step is 3", "at most 1"]),
    "a workspace as large as a hall": (inside("workspace", half_width=5), ["workspace.half_width is 5", "to 2"]),
    "not a mapping": (["joints"], ["['joints']", "expected an object of named values"]),
    "a part that is no mapping": (but(gripper=None), ["gripper is None"]),
    "a package that is not installed": (
        but(model="no_such_arms:arm.xml"),
        ["model is in 'no_such_arms'", "not installed", "pip install --no-deps no-such-arms"],
    ),
    "a model that is not there": (but(model="onw.xml"), ["cannot read", "onw.xml", "No such file"]),
    "a folder for a model": (but(model="."), ["robot own", "cannot read"]),
    "includes that are not there": (but(includes="parts", model="missing.xml"), ["cannot read", "missing.xml"]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_the_yaml_is_one_line(mistake: str, tmp_path: Path):
    tree, words = MISTAKES[mistake]
    path = write(tmp_path, tree=tree)
    line = refusal(path)
    for word in words:
        assert word in line
    assert str(path) in line or "robot own" in line  # the one where the YAML is read, the other where the model is


MODELS = {
    "no XML": ("<mujoco><worldbody>", ["robot own", "cannot read"]),
    "no MJCF": ("<html/>", ["robot own", "cannot read"]),
    "an unknown element": (
        MODEL.replace('<light name="lamp" pos="0 0 3"/>', "<lihgt/>"),
        ["robot own", "cannot read", "lihgt"],
    ),
    "bytes": ("\x00\x01", ["robot own", "cannot read"]),
    "a mesh that is not there": (
        MODEL.replace("</asset>", '<mesh name="shell" file="shell.stl"/></asset>').replace(
            '<geom type="sphere" size="0.02" mass="0.2"/>', '<geom type="mesh" mesh="shell"/>'
        ),
        ["robot own", "shell.stl"],
    ),
    "a body without mass": (
        MODEL.replace('<geom type="box" size="0.02 0.06 0.01" pos="0 0 0.01" mass="0.2"/>', ""),
        ["robot own", "mass"],
    ),
    "a finger that touches nothing": (
        MODEL.replace('size="0.01 0.004 0.04"', 'size="0.01 0.004 0.04" contype="0" conaffinity="0"', 1),
        ["finger 'left' has no geom that can touch anything"],
    ),
}


@pytest.mark.parametrize("model", MODELS)
def test_a_model_that_mujoco_cannot_read_is_one_line(model: str, tmp_path: Path):
    text, words = MODELS[model]
    line = refusal(write(tmp_path, model=text))
    for word in words:
        assert word in line


@pytest.mark.parametrize("model", ["a mesh that is not there", "a body without mass"])
def test_a_model_that_does_not_compile_is_named_with_its_file_however_short_the_yaml(model: str, tmp_path: Path):
    text, words = MODELS[model]
    short = {name: tree_of()[name] for name in ("model", "gripper", "workspace")} | {"hand": "hand"}
    path = write(tmp_path, tree=short, model=text)
    for tree in (short, tree_of()):
        line = refusal(write(tmp_path, "own", tree=tree, model=text))
        assert str(path.with_name("own.xml")) in line
        assert words[-1] in line
        get_robot.__globals__["_read"].cache_clear()


def test_a_driven_joint_that_moves_no_finger_is_one_line(tmp_path: Path):
    lid = """<body name="lid" pos="0.05 0 0"><joint name="lid" type="slide" axis="1 0 0" range="0 0.05"/>
             <geom size="0.005" mass="0.01"/></body><body name="left" """
    tree = inside("gripper", joints=["lid"], closed=[0.0], open=[0.05])
    fixed = re.sub(r'<joint name="(left|right)"[^>]*>', "", MODEL)
    line = refusal(write(tmp_path, tree=tree, model=fixed.replace('<body name="left" ', lid, 1)))
    assert "gripper.joints ('lid') from gripper.closed to gripper.open move none of gripper.fingers" in line


@pytest.mark.parametrize("text", ["joints: [", "\tjoints: 3", ""])
def test_text_that_is_no_yaml_is_one_line(text: str, tmp_path: Path):
    path = write(tmp_path)
    path.write_text(text)
    assert f"{path}" in refusal(path)
    assert ("is not YAML" if text else "None; expected an object of named values") in refusal(path)


def test_a_yaml_that_is_not_there_and_a_name_that_is_none_are_one_line(tmp_path: Path):
    assert "expected a robot's YAML" in refusal(tmp_path / "none.yaml")
    assert "a robot's name is 'my arm'" in refusal(write(tmp_path, "my arm"))


def test_a_name_that_is_neither_in_the_table_nor_a_yaml_gets_the_nearest():
    with pytest.raises(UnknownName, match=r"unknown robot 'pnada'.*did you mean 'panda'"):
        get_robot("pnada")


def test_a_gripper_too_small_for_the_tasks_cube_is_one_line(tmp_path: Path):
    path = write(tmp_path, tree=inside("gripper", open=[0.02, 0.02]))
    line = refusal(path, "pick_place")
    assert "task pick_place: 'object' is 0.050 m wide, and the gripper of own opens to 0.042 m" in line
    assert scene_of(str(path), "reach").gripper.most < 0.05


def test_nothing_that_belongs_to_a_world_is_left_of_a_model(own: Robot):
    spec = arm_spec(own)
    for kind in ("cameras", "lights", "sensors", "keys", "equalities", "textures"):
        assert list(getattr(spec, kind)) == [], kind
    assert [site.name for site in spec.sites] == ["ee"]
    assert not any(body.mocap for body in spec.bodies)
    assert sorted(motor.name for motor in spec.actuators) == sorted([*own.joints, *own.gripper.joints])
    model = spec.compile()
    assert (model.opt.timestep, model.opt.gravity[2]) == (0.002, -9.81)
    assert [material.name for material in spec.materials] == ["steel"]


@every_robot
def test_a_scene_has_the_worlds_cameras_lamps_and_sky_alone(robot: str):
    scene = scene_of(robot, "reach")
    model = scene.model
    assert sorted(model.camera(i).name for i in range(model.ncam)) == ["front", f"{PREFIX}wrist", "side"]
    assert all(model.light_bodyid == 0)
    assert model.nsensor == model.nkey == 0
    assert [model.body(i).name for i in range(model.nbody) if model.body_mocapid[i] >= 0] == ["goal"]
    skies = [i for i in range(model.ntex) if model.tex_type[i] == mujoco.mjtTexture.mjTEXTURE_SKYBOX]
    assert [model.texture(i).name for i in skies] == ["sky"]
    driven = {model.joint(int(model.actuator_trnid[i, 0])).name for i in range(model.nu)}
    assert driven == {PREFIX + name for name in (*scene.robot.joints, *scene.robot.gripper.joints)}
    assert model.nu == len(driven)


@pytest.mark.filterwarnings("error")
def test_a_models_own_world_is_left_out_without_a_warning(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file where it runs
    scene_of(str(write(tmp_path)), "reach")
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


@pytest.mark.parametrize("value", [-0.5, 0.0, 0.7])
@pytest.mark.parametrize("joint", ["turn", "elbow", "roll"])
def test_a_fixed_joint_stands_where_the_yaml_says(joint: str, value: float, tmp_path: Path):
    whole, tree = get_robot(str(write(tmp_path, "whole"))), tree_of()
    place = tree["joints"].index(joint)
    for values in (tree["joints"], tree["home"], tree["gains"]):
        del values[place]
    fixed = get_robot(str(write(tmp_path, "fixed", tree=tree | {"fixed": {joint: value}})))
    assert arm_model(fixed).njnt == arm_model(whole).njnt - 1
    held, free = ArmIK(fixed).ee_pose(np.full(4, 0.4)), ArmIK(whole).ee_pose(np.insert(np.full(4, 0.4), place, value))
    for one, other in zip(held, free, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


def test_a_base_moves_the_robot(tmp_path: Path):
    plain, moved = write(tmp_path, "plain"), write(tmp_path, "moved", tree=tree_of() | {"base": [0.1, 0.2, -0.3]})
    ees = [ArmIK(get_robot(str(path))).ee_pose(np.zeros(5))[0] for path in (plain, moved)]
    np.testing.assert_allclose(ees[1] - ees[0], [0.1, 0.2, -0.3], atol=1e-9)


@every_robot
def test_at_home_the_hand_points_down_over_the_workspace(robot: str):
    world = world_at_home(robot)
    np.testing.assert_allclose(world.ee.rotation, np.diag([1.0, -1.0, -1.0]), atol=0.05)
    assert np.hypot(*(world.ee.position[:2] - world.scene.robot.workspace.centre)) < 0.06


@every_robot
def test_the_fingers_move_along_the_hands_y(robot: str):
    world, places = world_at_home(robot), []
    gripper = world.scene.gripper
    for opening in (gripper.least, gripper.most):
        world.data.qpos[gripper.q] = gripper.command(opening)
        world.update()
        places.append(np.array([world.data.geom_xpos[pads[0]] for pads in gripper.pads]))
    moved = (places[1] - places[0]) @ world.ee.rotation
    moves = moved[np.abs(moved).max(axis=1) > 1e-9]  # of some one jaw alone
    assert len(moves) == 2 - world.lopsided
    assert (np.abs(moves[:, 1]) > 0.02).all()
    assert world.leans or (np.abs(moves[:, [0, 2]]) < 0.4 * np.abs(moves[:, [1]])).all()


@every_robot
def test_the_arm_alone_stands_where_the_scenes_arm_does(robot: str):
    world, model, rng = world_at_home(robot), arm_model(get_robot(robot)), np.random.default_rng(0)
    assert [model.joint(i).name for i in range(model.njnt)] == list(world.scene.robot.joints)  # and no others
    assert model.nu == 0
    alone, home = ArmIK(world.scene.robot), np.asarray(world.scene.robot.home)
    for _ in range(5):
        q = world.data.qpos[world.scene.arm_q] = home + rng.uniform(-0.5, 0.5, len(home))
        world.update()
        for one, other in zip(alone.ee_pose(q), world.ee, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-12)
