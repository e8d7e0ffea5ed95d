"""Models as others write them: in degrees, as URDF, with bodies turned in every way, with a
scene around them.
"""

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from manip_il.errors import UsageError
from manip_il.robots.found import suggest
from manip_il.robots.geometry import rotation_matrix
from manip_il.robots.robot import ModelFiles, Robot
from manip_il.robots.spec import arm_model, arm_spec, load
from manip_il.robots.table import get_robot

from .own import model_of, tree_of, write

# Angles are in [rad] here, as `A(...)`; the wrist has a joint whose zero is not where the model has
# it.
TURNED = (
    model_of("hinges")
    .replace('<compiler angle="radian"/>', "<compiler UNIT/>")
    .replace(
        'name="turn" axis="0 0 1" range="-2.9 2.9"',
        'name="turn" axis="0 0 1" range="A(-2.9 2.9)" ref="A(0.3)"',
    )
    .replace(
        '<body name="upper" pos="0 0 0.1">',
        '<body name="upper" pos="0 0 0.1" axisangle="0 0 1 A(0.2)">',
    )
    .replace(
        '<body name="base">',
        '<body name="base"><inertial pos="0 0 0" euler="A(0.4 0 0)" mass="1" diaginertia="1 2 3"/>',
    )
    .replace(
        '<body name="fore" pos="0 0 0.3">', '<body name="fore" pos="0 0 0.3" euler="A(0 0.1 0.2)">'
    )
    .replace(
        '<site name="grip"/>',
        '<geom type="box" size="0.01 0.02 0.03" euler="A(0.3 0 0)" mass="0.1"/>',
    )
    .replace(
        '<joint name="roll" axis="0 0 1"/>',
        '<joint name="roll" axis="0 0 1" springref="A(0.5)" stiffness="0.1"/>',
    )
)
ENDS = re.compile(r'(name="(?:shoulder|elbow|wrist|left|right)" axis="[^"]*" range=)"([^"]*)"')
LINK = """<link name="{0}"><inertial><mass value="0.2"/><inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0"
  iyz="0"/></inertial><collision><origin xyz="{1}"/><geometry><box size="{2}"/></geometry></collision></link>"""
JOINT = """<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="{4}"/><axis xyz="{5}"/>
  <limit lower="{6}" upper="{7}" effort="{8}" velocity="1"/></joint>"""


def in_unit(unit: str) -> str:
    """The arm's MJCF with its angles in `radian` or `degree`."""
    scale = math.degrees(1) if unit == "degree" else 1.0
    text = ENDS.sub(r'\1"A(\2)"', TURNED).replace("UNIT", f'angle="{unit}"')
    return re.sub(
        r"A\((.*?)\)",
        lambda found: " ".join(repr(float(one) * scale) for one in found[1].split()),
        text,
    )


def attached(folder: Path, unit: str) -> str:
    """Return the arm's MJCF, which attaches its hand from `folder`/hand.xml, written in the
    other unit.
    """
    arm, hand = (
        ET.fromstring(in_unit(one)) for one in (unit, "degree" if unit == "radian" else "radian")
    )
    wrist = arm.find(".//body[@name='wrist']")
    wrist.remove(wrist.find("body"))
    ET.SubElement(wrist, "attach", model="hand", body="hand", prefix="")
    ET.SubElement(arm.find("asset"), "model", name="hand", file="hand.xml")
    arm.remove(arm.find("equality"))
    world, part = hand.find("worldbody"), hand.find(".//body[@name='hand']")
    world.clear()
    world.append(part)
    for name in ("equality", "actuator", "sensor", "keyframe", "asset"):
        hand.remove(hand.find(name))
    (folder / "hand.xml").write_text(ET.tostring(hand, "unicode"))
    return ET.tostring(arm, "unicode")


def urdf() -> str:
    """An arm of five joints with two fingers; what a fixed joint carries is a link of its own."""
    links = [("base", "0 0 0.05", "0.1 0.1 0.1"), ("tower", "0 0 0.05", "0.06 0.06 0.05")]
    links += [(name, "0 0 0.15", "0.05 0.05 0.2") for name in ("upper", "fore")]
    links += [
        ("wrist", "0 0 0", "0.03 0.03 0.03"),
        ("tool", "0 0 0", "0.03 0.03 0.02"),
        ("hand", "0 0 0", "0.04 0.1 0.02"),
    ]
    links += [(name, "0 0 0.03", "0.02 0.008 0.06") for name in ("left", "right")]
    axes = {"turn": "0 0 1", "roll": "0 0 1"}
    chain = [
        ("turn", "base", "tower", 0.1),
        ("shoulder", "tower", "upper", 0.1),
        ("elbow", "upper", "fore", 0.3),
    ]
    chain += [("bend", "fore", "wrist", 0.3), ("roll", "wrist", "tool", 0.05)]
    joints = [
        JOINT.format(
            name, "revolute", one, other, f"0 0 {up}", axes.get(name, "0 1 0"), -2.5, 2.5, 30
        )
        for name, one, other, up in chain
    ]
    joints.append(JOINT.format("bolts", "fixed", "tool", "hand", "0 0 0.02", "0 0 1", 0, 0, 0))
    for name, side in (("left", 1), ("right", -1)):
        at = f"0 {0.005 * side} 0.01"
        joints.append(
            JOINT.format(f"{name}_slide", "prismatic", "hand", name, at, f"0 {side} 0", 0, 0.04, 20)
        )
    return (
        "<robot"
        f' name="bolted">{"".join(LINK.format(*one) for one in links)}{"".join(joints)}</robot>'
    )


def short(jaws: str = "slides") -> dict[str, Any]:
    return {name: tree_of(jaws)[name] for name in ("model", "gripper", "workspace")} | {
        "hand": "hand"
    }


def arrays(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    names = (
        "body_pos",
        "body_quat",
        "body_inertia",
        "body_iquat",
        "geom_pos",
        "geom_quat",
        "jnt_range",
        "qpos0",
    )
    names += (
        "qpos_spring",
        "actuator_ctrlrange",
        "actuator_gainprm",
        "actuator_forcerange",
        "dof_armature",
    )
    return {name: getattr(model, name) for name in names}


def test_an_arm_is_the_same_in_degrees_and_in_radians_and_if_its_hand_is_in_the_other_unit(
    tmp_path: Path,
):
    found, models, suggested = list[Robot](), [], []
    for place, unit in enumerate(("radian", "degree", "radian", "degree")):
        folder = tmp_path / str(place)
        folder.mkdir()
        path = write(
            folder,
            tree=short("hinges"),
            model=in_unit(unit) if place < 2 else attached(folder, unit),
        )
        found.append(get_robot(path))
        models.append(arrays(arm_spec(found[-1]).compile()))
        suggested.append(suggest(path.with_name("own.xml")))
    for robot, model, draft in zip(found[1:], models[1:], suggested[1:], strict=True):
        for name in ("home", "gains", "forces", "armature"):
            np.testing.assert_allclose(
                getattr(robot, name), getattr(found[0], name), rtol=1e-6, atol=1e-6
            )
        np.testing.assert_allclose(robot.ee.position, found[0].ee.position, atol=1e-6)
        for name, values in models[0].items():
            np.testing.assert_allclose(model[name], values, atol=1e-6, err_msg=name)
        assert draft == suggested[0]


@pytest.mark.parametrize(("joint", "value"), [("turn", -0.5), ("elbow", 0.7)])
def test_a_fixed_joint_is_where_mujoco_has_it(joint: str, value: float, tmp_path: Path):
    # Bodies turned by euler inside a turned frame, an anchor beside the body, a skew axis, a zero
    # that is elsewhere, and a second joint of the same body that goes on turning.
    model = (
        in_unit("degree")
        .replace('<body name="fore"', '<frame pos="0.01 0 0" euler="0 0 20"><body name="fore"')
        .replace('<body name="wrist"', '<body name="wrist" euler="10 0 0"', 1)
        .replace(
            '<joint name="elbow" axis="0 1 0"',
            '<joint name="elbow" axis="0.1 1 0.2" pos="0 0.02 0.01" ref="15"',
        )
        .replace(
            '<joint name="wrist"',
            '<joint name="second" pos="0.01 0 0" axis="1 0 0.3"/><joint name="wrist"',
        )
    )
    model = re.sub(
        r"(</body>\s*</body>\s*</body>\s*)(</body>\s*</body>\s*</body>\s*</worldbody>)",
        r"\1</frame>\2",
        model,
    )
    joints = ["turn", "shoulder", "elbow", "second", "wrist", "roll"]
    tree = short("hinges") | {
        "ee": tree_of()["ee"],
        "joints": joints,
        "home": [0.1] * 6,
        "gains": [100] * 6,
    }
    whole = get_robot(write(tmp_path, "whole", tree=tree, model=model))
    apart = [name for name in joints if name != joint]
    fixed = replace(
        whole,
        joints=tuple(apart),
        home=(0.1,) * 5,
        gains=(100.0,) * 5,
        forces=(9.0,) * 5,
        armature=(0.1,) * 5,
        fixed={joint: value},
    )
    poses = []
    for robot in (whole, fixed):
        compiled = arm_model(robot)
        data = mujoco.MjData(compiled)
        for name, at in {name: 0.4 for name in apart}.items() | (
            {joint: value}.items() if robot is whole else ()
        ):
            data.joint(name).qpos[0] = at
        mujoco.mj_kinematics(compiled, data)
        poses.append(np.concatenate([data.site("ee").xpos, data.site("ee").xmat]))
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-9)


@pytest.mark.parametrize("kind", ["urdf", "mjcf"])
def test_what_is_bolted_on_keeps_its_name(kind: str, tmp_path: Path):
    fused = '<compiler angle="radian" fusestatic="true" discardvisual="true" settotalmass="50"/>'
    model = urdf() if kind == "urdf" else model_of().replace('<compiler angle="radian"/>', fused)
    path = tmp_path / "arm.xml"
    path.write_text(model)
    found = suggest(path)
    assert (found["hand"], set(found["gripper"]["fingers"])) == ("hand", {"left", "right"})
    tree = tree_of() | {"hand": "hand", "gripper": found["gripper"], "joints": suggest_joints(kind)}
    robot = get_robot(write(tmp_path, tree=tree, model=model))
    bodies = [arm_spec(robot).compile().body(name).id for name in ("base", "hand")]
    assert bodies[0] == 1
    assert arm_model(robot).body("hand").id > bodies[0]
    assert float(arm_model(robot).body_mass.sum()) < 10


@pytest.mark.parametrize(
    "tensor", [(1.0, 2.0, 2.5, 0.0, 0.0, 0.0), (1.0, 2.0, 2.5, 0.2, 0.1, -0.3)]
)
def test_an_inertia_of_a_urdf_is_turned_with_its_origin(tensor: tuple[float, ...], tmp_path: Path):
    xx, yy, zz, xy, xz, yz = tensor
    roll, pitch, yaw = 0.3, 0.4, 0.5
    rotation = rotation_matrix(np.array([0, 0, yaw])) @ rotation_matrix(np.array([0, pitch, 0]))
    rotation = rotation @ rotation_matrix(np.array([roll, 0, 0]))
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    values = " ".join(f'{name}="{value}"' for name, value in zip(names, tensor, strict=True))
    turned = (
        f'<inertial><origin rpy="{roll} {pitch} {yaw}"/><mass value="1"/><inertia'
        f" {values}/></inertial>"
    )
    path = tmp_path / "arm.urdf"
    path.write_text(re.sub(r'(?s)(?<=<link name="fore">)<inertial>.*?</inertial>', turned, urdf()))
    body = load(ModelFiles(path), "arm").compile().body("fore")
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, body.iquat)
    axes = axes.reshape(3, 3)
    expected = rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
    np.testing.assert_allclose(axes @ np.diag(body.inertia) @ axes.T, expected, atol=1e-12)


def suggest_joints(kind: str) -> list[str]:
    return ["turn", "shoulder", "elbow", "bend" if kind == "urdf" else "wrist", "roll"]


def test_of_a_scene_around_a_robot_only_the_robot_is_taken(tmp_path: Path):
    around = """<worldbody><site name="ground"/><geom name="floor" type="plane" size="2 2 1"/>
      <geom name="desk" type="box" size="1 1 0.01" pos="0 0 -0.1"/>
      <body name="cube" pos="0.4 0 0.05"><freejoint/><geom name="cube" size="0.02 0.02 0.02" type="box"/></body>
      <body name="shelf" pos="0.4 0 0.05"><geom size="0.02 0.02 0.02" type="box"/></body>"""
    rest = """<contact><pair geom1="floor" geom2="cube"/></contact>
      <equality><weld site1="ground" site2="grip"/></equality>
      <custom><tuple name="all"><element objtype="body" objname="cube"/></tuple></custom></mujoco>"""
    scene = model_of().replace("<worldbody>", around, 1).replace("</mujoco>", rest)
    scene = scene.replace('mquat="1 0 0 0"', 'mquat="1 0 0 0" qpos="0 0 0 0 0 0 0 1 0 0 0 0 0 0"')
    (tmp_path / "around").mkdir()
    alone, inside = (
        arm_spec(get_robot(write(folder, model=model))).compile()
        for folder, model in ((tmp_path, model_of()), (tmp_path / "around", scene))
    )
    assert [inside.body(i).name for i in range(inside.nbody)] == [
        alone.body(i).name for i in range(alone.nbody)
    ]
    assert inside.ngeom == alone.ngeom
    assert inside.npair == 0
    assert suggest(tmp_path / "around" / "own.xml") == suggest(tmp_path / "own.xml")


def with_equality(folder: Path, equality: str) -> mujoco.MjModel:
    """Compile an arm with a rod beside its fore, whose joint is not the arm's, and an equality."""
    rod = (
        '<body name="rod" pos="0.05 0 0"><joint name="bar"/><geom size="0.01"/></body><body'
        ' name="fore"'
    )
    model = (
        model_of().replace("<equality>", f"<equality>{equality}").replace('<body name="fore"', rod)
    )
    return arm_spec(get_robot(write(folder, model=model))).compile()


@pytest.mark.parametrize(
    ("equality", "coupled"),
    [
        ('<joint name="belt" joint1="wrist" joint2="elbow"/>', "elbow, wrist"),
        ('<joint name="belt" joint1="bar" joint2="elbow"/>', "bar, elbow"),
        ('<connect name="belt" body1="rod" body2="fore" anchor="0 0 0"/>', "bar, elbow"),
        ('<weld name="belt" body1="upper" body2="wrist"/>', "elbow, wrist"),
    ],
)
def test_an_arm_whose_joints_are_coupled_is_refused(equality: str, coupled: str, tmp_path: Path):
    with pytest.raises(UsageError, match=f"own: equality belt couples {coupled};"):
        with_equality(tmp_path, equality)


@pytest.mark.parametrize(
    ("equality", "kept"),
    [
        ('<joint joint1="left" joint2="right"/>', 1),
        ('<weld body1="left" body2="right" active="false"/>', 1),
        ('<joint joint1="elbow" joint2="wrist" active="false"/>', 1),
        ('<joint joint1="bar"/>', 0),  # of a joint that is fixed
    ],
)
def test_fingers_may_be_coupled_and_so_may_joints_that_do_not_move(
    equality: str, kept: int, tmp_path: Path
):
    assert with_equality(tmp_path, equality).neq == kept
