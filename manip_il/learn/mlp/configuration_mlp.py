"""The options of the `mlp` policy, in LeRobot's form, and the schedule of its learning rate."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import override

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.learn.fit_config import MLPOptions
from manip_il.learn.names import JOINT_DELTA
from manip_il.learn.network import Shape

SIGMA = 3.0  # [bins]


@LRSchedulerConfig.register_subclass("warm_up_and_cosine")
@dataclass
class WarmUpAndCosineConfig(LRSchedulerConfig):
    """A linear warm-up of a tenth of the steps at most, then a cosine down to zero."""

    num_warmup_steps: int = 100  # type: ignore[assignment]

    @override
    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        warmup = min(self.num_warmup_steps, num_training_steps // 10)

        def share(step: int) -> float:
            if step < warmup:
                return (step + 1) / (warmup + 1)
            return 0.5 * (1.0 + math.cos(math.pi * (step - warmup) / max(1, num_training_steps - warmup)))

        return LambdaLR(optimizer, share)


@PreTrainedConfig.register_subclass("mlp")
@dataclass
class MLPConfig(PreTrainedConfig):
    """A multi-layer perceptron from joint and environment state to one action.

    loss: one of `manip_il.learn.losses.LOSSES`. components: of `mixture`. bins: a dimension, of
    `categorical`, over the range of the data. sigma: how far `categorical` smears a target, in bins; 0: over the two
    nearest. None is the default, but for a configuration with features, as a checkpoint's is: it was saved before there
    was a sigma, so it is 0. clamp: bound of the normalised inputs, in standard deviations, so that a state
    far off the data cannot blow the outputs up. action_space: of `manip_il.learn.action_spaces`, in which it learns.

    The network needs raw inputs (its targets may be relative to the measured joints), so LeRobot's
    normaliser steps are the identity and the statistics are buffers of the model.

    Raises `UnknownName` for a loss or activation that is not known, `UsageError` for a size out of range.
    """

    width: int = MLPOptions.width
    depth: int = MLPOptions.depth
    activation: str = "silu"
    loss: str = MLPOptions.loss
    components: int = 5
    bins: int = 21
    sigma: float | None = None
    clamp: float = 10.0
    action_space: str = JOINT_DELTA

    device: str | None = "cpu"
    push_to_hub: bool = False  # type: ignore[assignment]
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("STATE", "ENV", "VISUAL", "ACTION"), NormalizationMode.IDENTITY)
    )
    optimizer_lr: float = 2e-3
    optimizer_weight_decay: float = 1e-4
    scheduler_warmup_steps: int = 100

    observation_delta_indices = action_delta_indices = reward_delta_indices = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sigma is None:
            self.sigma = 0.0 if self.input_features else SIGMA
        try:
            self.network_shape()
        except UsageError:
            raise
        except ManipError as error:
            raise UsageError(f"policy.{error}") from error

    def network_shape(self) -> Shape:
        """Return the part that the network is built from."""
        return Shape(**{field.name: getattr(self, field.name) for field in fields(Shape)})

    @override
    def validate_features(self) -> None:
        """Raise unless `observation.state` and `action` are there with one and the same size."""
        state, action = self.robot_state_feature, self.action_feature
        if state is None or action is None:
            have = ", ".join([*(self.input_features or {}), *(self.output_features or {})])
            raise UsageError(f"the {self.type} policy needs observation.state and action; the features are {have}")
        if len(state.shape) != 1 or state.shape != action.shape:
            raise MismatchError("shape", "observation.state", state.shape, "action", action.shape)

    @override
    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay)

    @override
    def get_scheduler_preset(self) -> LRSchedulerConfig:
        return WarmUpAndCosineConfig(self.scheduler_warmup_steps)
