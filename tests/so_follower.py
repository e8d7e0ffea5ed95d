"""The real SO-101 as LeRobot's own `SOFollower`, with a bus that has no wire: its servos stand
where they are put.

Units, names and features are all LeRobot's; ours are compared with them.
"""

from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets import (
    LeRobotDataset,
    aggregate_pipeline_dataset_features,
    create_initial_features,
)
from lerobot.motors import MotorCalibration
from lerobot.motors.feetech import FeetechMotorsBus
from lerobot.processor import make_default_processors
from lerobot.robots.so_follower import SOFollower, SOFollowerRobotConfig, so_follower
from lerobot.utils.constants import ACTION, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame, combine_feature_dicts

TURN = 4096  # steps of a servo in a whole turn
MIDDLE = 2047.5  # of a servo's steps


class Bus(FeetechMotorsBus):
    """Servos that stand where the last command put them. steps: of each, by name."""

    def __init__(self, port: str, motors: dict[str, Any], calibration: Any = None) -> None:
        self.port, self.motors, self.calibration = port, motors, calibration
        self._id_to_model_dict = {motor.id: motor.model for motor in motors.values()}
        self._id_to_name_dict = {motor.id: name for name, motor in motors.items()}
        self.steps = dict.fromkeys(motors, 0)

    @property
    def is_connected(self) -> bool:
        return True

    def sync_read(self, data_name: str, motors: Any = None, **options: Any) -> dict[str, Any]:
        assert data_name == "Present_Position"
        found = self._normalize(self._get_ids_values_dict(self.steps))
        return {self._id_to_name(number): value for number, value in found.items()}

    def sync_write(self, data_name: str, values: Any, **options: Any) -> None:
        assert data_name == "Goal_Position"
        found = self._unnormalize(self._get_ids_values_dict(values))
        self.steps |= {self._id_to_name(number): value for number, value in found.items()}

    def stand(self, joints: dict[str, float]) -> None:
        """Put servos at angles [rad] of the model's joints, as far as their steps allow."""
        self.steps |= {
            name: round(MIDDLE + angle * TURN / (2 * np.pi)) for name, angle in joints.items()
        }


class Camera:
    """A camera that sees what it is shown."""

    is_connected = True

    def __init__(self, height: int, width: int) -> None:
        self.height, self.width = height, width
        self.picture = np.zeros((height, width, 3), np.uint8)

    def read_latest(self) -> np.ndarray:
        return self.picture


def arm(
    monkeypatch: Any,
    limits: dict[str, tuple[float, float]],
    cameras: dict[str, Camera] | None = None,
) -> Any:
    """A connected arm, calibrated to joints' limits [rad] in the model, as docs/real-robot.md
    asks for.
    """
    monkeypatch.setattr(so_follower, "FeetechMotorsBus", Bus)
    robot: Any = SOFollower(SOFollowerRobotConfig(port="none", id="none"))
    robot.cameras = cameras or {}
    ends = {
        name: [round(MIDDLE + end * TURN / (2 * np.pi)) for end in limits[name]]
        for name in robot.bus.motors
    }
    ends["wrist_roll"] = [0, 4095]  # as LeRobot calibrates it
    for number, (name, (low, high)) in enumerate(ends.items(), start=1):
        robot.bus.calibration[name] = MotorCalibration(number, 0, 0, low, high)
    return robot


def recorders_features(robot: Any) -> dict[str, Any]:
    """The features of a dataset that lerobot-record makes for a robot, as
    `lerobot_record.record` makes them.
    """
    teleop, _, observation = make_default_processors()
    return combine_feature_dicts(
        aggregate_pipeline_dataset_features(
            pipeline=teleop,
            initial_features=create_initial_features(action=robot.action_features),
            use_videos=True,
        ),
        aggregate_pipeline_dataset_features(
            pipeline=observation,
            initial_features=create_initial_features(observation=robot.observation_features),
            use_videos=True,
        ),
    )


def record(robot: Any, root: Path, steps: int, episodes: int, task: str) -> LeRobotDataset:
    """Write a dataset as `lerobot_record.record_loop` does, its leader standing still."""
    dataset = LeRobotDataset.create(
        "someone/real",
        30,
        root=root,
        robot_type=robot.name,
        features=recorders_features(robot),
        use_videos=True,
        rgb_encoder=RGBEncoderConfig(),
    )
    for _ in range(episodes):
        for _ in range(steps):
            observed = robot.get_observation()
            action = {name: value for name, value in observed.items() if name.endswith(".pos")}
            robot.send_action(action)
            frame = build_dataset_frame(dataset.features, observed, prefix=OBS_STR)
            frame |= build_dataset_frame(dataset.features, action, prefix=ACTION)
            dataset.add_frame({**frame, "task": task})
        dataset.save_episode()
    dataset.finalize()
    return dataset
