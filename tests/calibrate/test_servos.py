"""Servos are found from goals and positions alone, and simulated arms take what was found."""

from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from manip_il.calibrate.servos import ArmMotion, ServoArm, in_units, parameters, to_angles
from manip_il.cli.main import main
from manip_il.data.dataset import Dataset
from manip_il.lerobot_plugin.teleoperator import Recorded, RecordedConfig
from manip_il.mdp import F64
from manip_il.robots.servos import PARAMETERS, default_servo, servo_ranges
from manip_il.robots.table import get_robot
from manip_il.sim.world import World
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
        goals,
        ServoArm.of_scene(SCENE, FPS).positions(hidden_servos()[None], ArmMotion(goals, start))[0],
    )


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("arm") / "dataset"
    column = {"dtype": "float32", "shape": (len(JOINTS),), "names": list(JOINTS)}
    made = LeRobotDataset.create(
        "local/arm", FPS, {"action": column, "observation.state": column}, root, "so_follower"
    )
    motion = moved()
    frames = (in_units(SCENE.robot, one) for one in (motion.goals, motion.positions))
    for goal, position in zip(*(one.astype(np.float32) for one in frames), strict=True):
        made.add_frame({"action": goal, "observation.state": position, "task": "move"})
    made.save_episode()
    made.finalize()
    return root


def test_hidden_servos_are_found(dataset: Path, tmp_path: Path):
    assert main(["robot", "identify", str(dataset), f"--output_dir={tmp_path / 'found'}"]) == 0
    assert (tmp_path / "found/report.html").is_file()
    robot = get_robot(tmp_path / "found/arm.yaml")
    assert robot.name == "arm"
    assert robot.workspace == SCENE.robot.workspace
    values, low, high = servo_ranges(robot.servos, JOINTS)
    hidden = hidden_servos()
    assert ((low <= hidden) & (hidden <= high)).mean() > 0.95
    told = [PARAMETERS.index(name) for name in ("stiffness", "speed", "delay")]
    lift = [*JOINTS].index("shoulder_lift.pos")
    assert values[lift, told] == pytest.approx(hidden[lift, told], rel=0.1)
    scene_of(tmp_path / "found/arm.yaml", "reach")


def test_a_dataset_of_another_arm_is_one_line(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    words = ["robot", "identify", str(dataset), "--robot.type=panda"]
    assert main([*words, f"--output_dir={tmp_path / 'found'}"]) in (1, 2)
    [line] = capsys.readouterr().err.strip().splitlines()
    assert "action" in line


def test_a_motion_is_clear_within_the_limits_and_played_by_lerobot(tmp_path: Path):
    """Simulated with the default servos, the hand stays above the table."""
    assert main(["robot", "excite", str(tmp_path / "motion"), "--seconds=30"]) == 0
    dataset = Dataset.open(tmp_path / "motion")
    goals = to_angles(SCENE.robot, dataset.columns(["action"])["action"])
    assert len(goals) == 30 * FPS + 1
    assert (np.ptp(goals, axis=0) > 0.5).all()
    servos = np.tile(default_servo(), (1, len(JOINTS), 1))
    places = ServoArm.of_scene(SCENE, FPS).positions(servos, ArmMotion(goals, goals))[0]
    world, q = World(SCENE), np.append(SCENE.arm_q, SCENE.gripper.q)
    for place in places:
        world.data.qpos[q] = place
        world.update()
        assert world.ee.position[2] > 0.04
    teleoperator = Recorded(RecordedConfig(root=tmp_path / "motion", calibration_dir=tmp_path))
    played = [teleoperator.get_action() for _ in range(len(goals) + 1)]
    assert [*played[0]] == [*JOINTS] == [*teleoperator.action_features]
    assert played[-1] == played[-2] != played[0]
