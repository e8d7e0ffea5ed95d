"""A first YAML for an arm, from its MJCF."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from manip_il.cli.main import main
from manip_il.errors import UsageError
from manip_il.robots.found import suggest
from manip_il.robots.table import get_robot, read_robot

from .own import ARM, JAWS, model_of, tree_of


def model_in(folder: Path, jaws: str) -> Path:
    path = folder / "arm.xml"
    path.write_text(model_of(jaws))
    return path


@pytest.mark.parametrize("jaws", JAWS)
def test_hand_and_fingers_are_found_and_which_way_they_open(jaws: str, tmp_path: Path):
    found, said = suggest(model_in(tmp_path, jaws)), tree_of(jaws)["gripper"]
    gripper = found["gripper"]
    assert found["hand"] == "hand"
    assert set(gripper["joints"]) == set(said["joints"])
    assert set(gripper["fingers"]) == set(said["fingers"])
    assert np.sign(np.subtract(gripper["open"], gripper["closed"])).tolist() == [1.0, 1.0]


def test_one_jaw_that_moves_has_the_hand_for_the_other():
    found = suggest(get_robot("so101").files.model)
    gripper = found["gripper"]
    assert (found["hand"], gripper["joints"]) == ("gripper", ["gripper"])
    assert gripper["fingers"] == ["gripper", "moving_jaw_so101_v1"]
    assert gripper["open"] > gripper["closed"]


def test_a_gripper_of_its_own_goes_onto_the_last_body(tmp_path: Path):
    arm, gripper = model_in(tmp_path, "slides"), tmp_path / "gripper.xml"
    arm.write_text(ARM.replace("FINGERS", '<body name="flange"><geom size="0.01"/></body>'))
    gripper.write_text(
        f'<mujoco><worldbody><body name="palm">{JAWS["slides"][0]}</body></worldbody></mujoco>'
    )
    found = suggest(arm, gripper)
    assert found["hand"] == "flange"
    assert set(found["gripper"]["joints"]) == {"left", "right"}


def test_an_arm_without_fingers_is_refused_in_one_line(tmp_path: Path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.replace("FINGERS", ""))
    with pytest.raises(UsageError, match=r"arm\.xml.*not named like a jaw.*--gripper=PATH"):
        suggest(path)


PIECES = {
    "assets": "<mujoco><asset/></mujoco>",
    "a body": "<mujoco><body name='arm'><joint/><geom size='1'/></body></mujoco>",
    "included": "<mujocoinclude><body name='arm'><joint/><geom size='1'/></body></mujocoinclude>",
}


@pytest.mark.parametrize("piece", PIECES)
def test_a_piece_of_a_model_is_called_a_fragment(piece: str, tmp_path: Path):
    path = tmp_path / "arm.xml"
    path.write_text(PIECES[piece])
    with pytest.raises(UsageError, match=r"arm\.xml.*is a fragment"):
        suggest(path)


def with_gripper(folder: Path, quat: str) -> list[str]:
    """The words that make a YAML for an arm and a gripper's model, whose palm is turned."""
    flange = '<body name="flange" pos="0 0 0.02"><geom size="0.01"/></body>'
    palm = (
        f'<body name="palm" quat="{quat}"><geom size="0.02 0.06 0.01"'
        f' type="box"/>{JAWS["slides"][0]}</body>'
    )
    (folder / "arm.xml").write_text(ARM.replace("FINGERS", flange))
    (folder / "gripper.xml").write_text(f"<mujoco><worldbody>{palm}</worldbody></mujoco>")
    return ["robot", "new", str(folder / "arm.xml"), f"--gripper={folder / 'gripper.xml'}"]


def test_a_hand_put_on_sideways_is_written_without_success_and_the_remedy_named(
    tmp_path: Path, capsys
):
    assert main(with_gripper(tmp_path, "0.7071 0.7071 0 0")) == 2
    out, err = capsys.readouterr()
    assert out == f"robot: {tmp_path / 'arm.yaml'}\n"
    assert "gripper.quaternion" in err
    assert yaml.safe_load((tmp_path / "arm.yaml").read_text())["hand"] == "flange"


@pytest.mark.slow
def test_the_command_writes_a_yaml_that_is_a_robot_and_says_what_it_can_do(tmp_path: Path, capsys):
    path = tmp_path / "arm.yaml"
    words = ["robot", "new", str(model_in(tmp_path, "slides"))]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "arm has starts for 12 of 12 tasks" in said
    assert read_robot(path).joints
    assert main(words) == 2  # there is one
    assert "already exists" in capsys.readouterr().err
