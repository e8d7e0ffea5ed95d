"""Servos are found from goals and positions alone, and `serve` takes what was found."""

from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from manip_il.calibrate.servos import ArmMotion, ServoArm, parameters
from manip_il.cli.main import main
from manip_il.mdp import F64
from manip_il.serve.config import SessionConfig
from manip_il.serve.servo import PARAMETERS, draw_servos, read_servos
from manip_il.worlds.ladder.world import scene_of

FPS, SECONDS = 30, 4
SCENE = scene_of("so101", "reach")
JOINTS = SCENE.actions.names
RESTED = np.array([0.0, -0.6, 0.4, 0.8, 0.0, 0.5])  # clear of the table [rad]
HIDDEN = {"stiffness": 0.4, "delay": 0.5, "friction": -0.5}  # deviations from the default


def hidden_servos() -> F64:
    """Return the servos to find, (n, 8)."""
    deviations = np.zeros((len(JOINTS), len(PARAMETERS)))
    for name, deviation in HIDDEN.items():
        deviations[:, PARAMETERS.index(name)] = deviation
    return parameters(deviations)


def moved() -> ArmMotion:
    """Return how an arm with the hidden servos follows jumps and swings."""
    rng = np.random.default_rng(0)
    seconds = np.arange(FPS * SECONDS)[:, None] / FPS
    jumps = np.repeat(rng.uniform(-0.25, 0.25, (SECONDS, len(JOINTS))), FPS, axis=0)
    swings = 0.2 * np.sin(2 * np.pi * rng.uniform(0.3, 0.9, len(JOINTS)) * seconds)
    goals = RESTED + np.where(seconds < SECONDS / 2, jumps, swings)
    start = np.tile(RESTED, (len(goals), 1))
    return ArmMotion(
        goals, ServoArm(SCENE, FPS).positions(hidden_servos()[None], ArmMotion(goals, start))[0]
    )


def in_units(angles: F64) -> F64:
    """Return joint angles (T, n) [rad] as LeRobot records them."""
    assert SCENE.robot.lerobot is not None
    closed, opened = SCENE.robot.lerobot.gripper
    share = 100 * (angles[:, -1:] - closed) / (opened - closed)
    return np.concatenate([np.degrees(angles[:, :-1]), share], axis=1)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("arm") / "dataset"
    column = {"dtype": "float32", "shape": (len(JOINTS),), "names": list(JOINTS)}
    made = LeRobotDataset.create(
        "local/arm", FPS, {"action": column, "observation.state": column}, root, "so_follower"
    )
    motion = moved()
    frames = in_units(motion.goals), in_units(motion.positions)
    for goal, position in zip(*(one.astype(np.float32) for one in frames), strict=True):
        made.add_frame({"action": goal, "observation.state": position, "task": "move"})
    made.save_episode()
    made.finalize()
    return root


def test_hidden_servos_are_found_and_served(dataset: Path, tmp_path: Path):
    assert main(["robot", "identify", str(dataset), f"--output_dir={tmp_path / 'found'}"]) == 0
    assert (tmp_path / "found/report.html").is_file()
    values, low, high = read_servos(tmp_path / "found/servos.yaml", JOINTS)
    hidden = hidden_servos()
    assert ((low <= hidden) & (hidden <= high)).mean() > 0.95
    told = [PARAMETERS.index(name) for name in ("stiffness", "speed", "delay")]
    lift = [*JOINTS].index("shoulder_lift.pos")
    assert values[lift, told] == pytest.approx(hidden[lift, told], rel=0.1)
    same, drawn = (
        draw_servos(SessionConfig(servo=tmp_path / "found/servos.yaml", varies=varies), JOINTS, 1)
        for varies in (False, True)
    )
    assert np.array_equal(same["delay"], values[:, PARAMETERS.index("delay")])
    assert (low[:, 0] <= drawn["stiffness"]).all()
    assert not np.array_equal(drawn["stiffness"], same["stiffness"])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("shoulder_pan: 3", "shoulder_pan is 3"),
        ("shoulder_pan: {stiffness: 3}", "stiffness of shoulder_pan is 3"),
    ],
)
def test_a_wrong_file_of_servos_is_one_line(
    content: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "servos.yaml").write_text(content)
    words = ["serve", f"--servo={tmp_path / 'servos.yaml'}", f"--output_dir={tmp_path / 'out'}"]
    assert main(words) in (1, 2)
    [line] = capsys.readouterr().err.strip().splitlines()
    assert said in line


def test_a_dataset_of_another_arm_is_one_line(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    words = ["robot", "identify", str(dataset), "--robot.type=panda"]
    assert main([*words, f"--output_dir={tmp_path / 'found'}"]) in (1, 2)
    [line] = capsys.readouterr().err.strip().splitlines()
    assert "action" in line
