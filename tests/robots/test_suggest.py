"""A first YAML for an arm, from its MJCF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from manip_il.cli.main import main
from manip_il.errors import UsageError
from manip_il.robots.robot import Robot, get_robot
from manip_il.robots.suggest import suggest

from .own import ARM, JAWS, model_of, tree_of


def model_in(folder: Path, jaws: str) -> Path:
    path = folder / "arm.xml"
    path.write_text(model_of(jaws))
    return path


@pytest.mark.parametrize("jaws", JAWS)
def test_hand_and_fingers_are_found_and_which_way_they_open(jaws: str, tmp_path: Path):
    found, said = suggest(model_in(tmp_path, jaws)), tree_of(jaws)["gripper"]
    assert found.hand == "hand"
    assert set(found.joints) == set(said["joints"])
    assert set(found.fingers) == set(said["fingers"])
    assert np.sign(np.subtract(found.open, found.closed)).tolist() == [1.0, 1.0]


def test_one_jaw_that_moves_has_the_hand_for_the_other():
    found = suggest(get_robot("so101").files.model)
    assert (found.hand, found.joints) == ("gripper", ("gripper",))
    assert found.fingers == ("gripper", "moving_jaw_so101_v1")
    assert found.open[0] > found.closed[0]


def test_a_gripper_of_its_own_goes_onto_the_last_body(tmp_path: Path):
    arm, gripper = model_in(tmp_path, "slides"), tmp_path / "gripper.xml"
    arm.write_text(ARM.replace("FINGERS", '<body name="flange"><geom size="0.01"/></body>'))
    gripper.write_text(f'<mujoco><worldbody><body name="palm">{JAWS["slides"][0]}</body></worldbody></mujoco>')
    found = suggest(arm, gripper)
    assert found.hand == "flange"
    assert set(found.joints) == {"left", "right"}


def test_an_arm_without_fingers_is_refused_in_one_line(tmp_path: Path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.replace("FINGERS", ""))
    with pytest.raises(UsageError, match=r"arm\.xml.*no jaw by its name.*--gripper=PATH"):
        suggest(path)


def test_the_command_writes_a_yaml_that_is_a_robot(tmp_path: Path, capsys):
    path = tmp_path / "arm.yaml"
    assert main(["robot", "new", str(model_in(tmp_path, "slides"))]) == 0
    text = path.read_text()
    assert f"--robot.type={path}" in "".join(capsys.readouterr())
    said = [line for line in text.splitlines() if not line.startswith("#")]
    assert len(said) <= 15
    robot = Robot.read(path)
    comments = yaml.safe_load("\n".join(line[2:] for line in text.splitlines()[-6:]))
    assert comments["joints"] == list(robot.joints)
    np.testing.assert_allclose(comments["home"], robot.home, rtol=1e-4)
    np.testing.assert_allclose(comments["gains"], robot.gains, rtol=1e-4)
    assert main(["robot", "new", str(tmp_path / "arm.xml")]) == 2  # there is one
    assert "exists already" in capsys.readouterr().err
    assert main(["robot", "new", str(tmp_path / "arm.xml"), "--overwrite"]) == 0


def test_what_is_found_may_be_said(tmp_path: Path):
    assert main(["robot", "new", str(model_in(tmp_path, "slides"))]) == 0
    path = tmp_path / "arm.yaml"
    lines = path.read_text().splitlines()
    said = tmp_path / "said.yaml"
    said.write_text("\n".join([*lines[:-6], *(line[2:] for line in lines[-6:])]))
    one, other = Robot.read(path), Robot.read(said)
    assert one.joints == other.joints
    np.testing.assert_allclose(one.home, other.home, atol=1e-4)
    np.testing.assert_allclose(one.ee.position, other.ee.position, atol=1e-4)
