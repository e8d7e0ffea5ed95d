"""The options of the `cnn` policy, in LeRobot's form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import override

from lerobot.configs import PreTrainedConfig

from manip_il.errors import MismatchError, UsageError
from manip_il.learn.mlp.configuration_mlp import MLPConfig

MIN_SIDE = 32  # of a picture [pixels]


@PreTrainedConfig.register_subclass("cnn")
@dataclass
class CNNConfig(MLPConfig):
    """Keypoints of every camera, found by a small convolutional network, and the mlp's perceptron on top.

    channels: of the encoder's layers; the first two halve the picture, the rest keep its size. keypoints: a
    camera. aux_weight: while learning, weight of the mean absolute error, in standard deviations, of reading
    `observation.environment_state` off the keypoints by a linear layer, where the dataset has that column and
    it is not an input; acting never sees it. What is not said here is the mlp's.

    `use_amp` takes the convolutions of learning to half precision: 1.7 times as fast on a CPU that has bfloat16.
    Acting is always in single precision.

    Raises what `MLPConfig` raises, `UsageError` for sizes and weights out of range.
    """

    channels: tuple[int, ...] = (16, 32, 48, 48)
    keypoints: int = 32
    aux_weight: float = 0.5
    privileged_size: int = 0  # of what is read off beside the action; taken from the dataset

    depth: int = 2
    scheduler_warmup_steps: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        self.channels = tuple(self.channels)
        if len(self.channels) < 2 or min(self.channels) < 1:
            raise UsageError(f"policy.channels is {list(self.channels)}; expected at least two layers of at least 1")
        if self.keypoints < 1:
            raise UsageError(f"policy.keypoints is {self.keypoints}; expected at least 1")
        for name in ("aux_weight", "privileged_size"):
            if not getattr(self, name) >= 0:
                raise UsageError(f"policy.{name} is {getattr(self, name)}; expected 0 (off) or more")

    @override
    def validate_features(self) -> None:
        """Raise unless there are `observation.state`, `action` of the same size, and pictures, (3, H, W) each."""
        super().validate_features()
        if not self.image_features:
            have = ", ".join(self.input_features or {})
            raise UsageError(f"the cnn policy needs pictures (observation.images.*); the inputs are {have}")
        for key, feature in self.image_features.items():
            shape = tuple(feature.shape)
            if len(shape) != 3 or shape[0] != 3 or min(shape[1:]) < MIN_SIDE:
                raise MismatchError("shape", key, shape, "the cnn policy", f"(3, >= {MIN_SIDE}, >= {MIN_SIDE})")
