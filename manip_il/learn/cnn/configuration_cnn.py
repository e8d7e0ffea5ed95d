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
    `observation.environment_state` off joints and keypoints by a perceptron, where the dataset has that column and
    it is not an input. The action is read off what was read off, too, and off joints and keypoints; acting never sees
    the true state. heatmap_weight: while learning, weight of the cross-entropy [nats] of heat maps against the places
    of points that the scene names (`privileged.keypoints.<camera>`), each of which has a keypoint of its own beside the
    others; 0: off. What is not said here is the mlp's.

    `use_amp` takes the convolutions of learning to half precision, where the processor has bfloat16: twice as fast.
    Acting is always in single precision.

    Raises what `MLPConfig` raises, `UsageError` for sizes and weights out of range.
    """

    channels: tuple[int, ...] = (16, 32, 32, 32)
    keypoints: int = 32
    aux_weight: float = 0.5
    heatmap_weight: float = 0.0
    privileged_size: int = 0  # of what is read off beside the action; taken from the dataset
    named_points: int = 0  # that have a heat map; taken from the dataset

    depth: int = 2
    loss: str = "l1"
    use_amp: bool = True
    scheduler_warmup_steps: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        self.channels = tuple(self.channels)
        if len(self.channels) < 2 or min(self.channels) < 1 or self.keypoints < 1:
            raise UsageError(
                f"policy.channels is {list(self.channels)}, keypoints {self.keypoints}; expected two layers or "
                "more, and at least 1"
            )
        for name in ("aux_weight", "heatmap_weight"):
            if not getattr(self, name) >= 0:
                raise UsageError(f"policy.{name} is {getattr(self, name)}; expected 0 or more")

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
