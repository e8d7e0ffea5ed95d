"""LeRobot's teleoperator type `recorded`: the actions of a dataset, one by one, so that
`lerobot-record` records what an arm makes of them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, override

from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator

from manip_il.data.dataset import Dataset


@TeleoperatorConfig.register_subclass("recorded")
@dataclass(kw_only=True)
class RecordedConfig(TeleoperatorConfig):
    """`--teleop.type=recorded`: `root` is the dataset's folder."""

    root: Path


class Recorded(Teleoperator):
    """Gives the actions of a dataset in turn, and the last one from then on."""

    config_class = RecordedConfig
    name = "recorded"

    def __init__(self, config: RecordedConfig):
        """Read the dataset."""
        super().__init__(config)
        dataset = Dataset.open(config.root)
        self._names: list[str] = dataset.features["action"].table["names"]
        self._actions = dataset.columns(["action"])["action"]
        self._next = 0

    @override
    def get_action(self) -> dict[str, Any]:
        action = self._actions[min(self._next, len(self._actions) - 1)]
        self._next += 1
        return dict(zip(self._names, action.tolist(), strict=True))

    @property
    @override
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self._names, float)

    @property
    @override
    def feedback_features(self) -> dict[str, Any]:
        return {}

    @property
    @override
    def is_connected(self) -> bool:
        return True  # there is no device

    @property
    @override
    def is_calibrated(self) -> bool:
        return True

    @override
    def connect(self, calibrate: bool = True) -> None:
        pass

    @override
    def calibrate(self) -> None:
        pass

    @override
    def configure(self) -> None:
        pass

    @override
    def send_feedback(self, feedback: dict[str, Any]) -> None:
        pass

    @override
    def disconnect(self) -> None:
        pass
