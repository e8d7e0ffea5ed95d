"""The options of the `preference` reward model, in LeRobot's form."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import override

from lerobot.configs.rewards import RewardModelConfig

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE
from manip_il.errors import UsageError
from manip_il.learn.preference.network import RewardShape


@RewardModelConfig.register_subclass("preference")
@dataclass
class PreferenceConfig(RewardModelConfig):
    """An ensemble of perceptrons from joint state, environment state and action to a reward.

    Raises what `RewardShape` raises.
    """

    members: int = RewardShape.members
    width: int = RewardShape.width
    depth: int = RewardShape.depth
    ways: list[list[int]] = field(default_factory=list)
    unread: list[int] = field(default_factory=list)
    logarithms: bool = RewardShape.logarithms

    device: str | None = "cpu"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.network_shape()

    def network_shape(self) -> RewardShape:
        """Return the part that the network is built from."""
        ways = tuple(map(tuple, self.ways))
        return RewardShape(self.members, self.width, self.depth, ways, tuple(self.unread), self.logarithms)

    @override
    def validate_features(self) -> None:
        """Raise `UsageError` unless the inputs are the three that the network takes."""
        if missing := {STATE, ENVIRONMENT_STATE, ACTION} - self.input_features.keys():
            raise UsageError(f"the {self.type} reward model needs {', '.join(sorted(missing))} among its inputs")
