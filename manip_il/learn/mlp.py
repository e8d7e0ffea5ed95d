"""The `mlp` policy in LeRobot's form: its options, its policy class and its processors.

LeRobot expects all three in the module of the options class. A LeRobot plugin must be a package,
for `--policy.discover_packages_path=manip_il.learn.mlp`: hence `__path__`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, override

import numpy as np
import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from manip_il.data.dataset import Dataset
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, LABEL_VALID, STATE
from manip_il.errors import ManipError, UsageError
from manip_il.learn.names import EE_DELTA, JOINT_DELTA
from manip_il.learn.network import MLPNetwork, NetworkConfig
from manip_il.learn.samples import TASK, Table, label_valid
from manip_il.learn.texts import LENGTH, tokens

__path__: list[str] = []


@LRSchedulerConfig.register_subclass("warm_up_and_cosine")
@dataclass
class WarmUpAndCosineConfig(LRSchedulerConfig):
    """A linear warm-up of at most a tenth of the steps, then a cosine down to zero."""

    num_warmup_steps: int = 100  # type: ignore[assignment]

    @override
    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        warmup = min(self.num_warmup_steps, num_training_steps // 10)

        def share(step: int) -> float:
            if step < warmup:
                return (step + 1) / (warmup + 1)
            return 0.5 * (
                1.0 + math.cos(math.pi * (step - warmup) / max(1, num_training_steps - warmup))
            )

        return LambdaLR(optimizer, share)


@PreTrainedConfig.register_subclass("mlp")
@dataclass
class MLPConfig(NetworkConfig, PreTrainedConfig):
    """A multi-layer perceptron from joint and environment state to one action.

    Its options are those of its network.

    The network needs raw inputs (its targets may be relative to the measured joints), so LeRobot's
    normaliser steps are the identity and the statistics are buffers of the model.
    """

    device: str | None = "cpu"
    push_to_hub: bool = False  # type: ignore[assignment]
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(
            ("STATE", "ENV", "VISUAL", "ACTION"), NormalizationMode.IDENTITY
        )
    )
    optimizer_lr: float = 2e-3
    optimizer_weight_decay: float = 1e-4
    scheduler_warmup_steps: int = 100

    observation_delta_indices = None  # type: ignore[assignment]
    action_delta_indices = None  # type: ignore[assignment]
    reward_delta_indices = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        PreTrainedConfig.__post_init__(self)
        NetworkConfig.__post_init__(self)

    @override
    def validate_features(self) -> None:
        """Raise unless `observation.state` and `action` exist, of the same size if targets are
        relative.
        """
        state, action = self.robot_state_feature, self.action_feature
        is_relative = self.action_space == JOINT_DELTA
        if not state or not action or (is_relative and state.shape != action.shape):
            raise UsageError(
                f"the {self.type} policy needs observation.state and action, of the same size in"
                f" the action space {JOINT_DELTA}; they are {state} and {action}"
            )

    @override
    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay)

    @override
    def get_scheduler_preset(self) -> LRSchedulerConfig:
        return WarmUpAndCosineConfig(self.scheduler_warmup_steps)


class MLPPolicy(PreTrainedPolicy):
    """LeRobot's policy interface to `MLPNetwork`.

    Batches hold `observation.state` (B, n), `observation.environment_state` (B, k) and, in
    training, `action` (B, n), all raw ([rad], [m]).

    Args:
        config: The options, with features.
        dataset_meta: For training, LeRobot's metadata, which `make_policy` passes on; see
            `training_table`. The statistics are then computed from the frames with a valid label.
    """

    config: Any  # `MLPConfig`, or that of a subclass
    config_class = MLPConfig  # type: ignore[assignment]
    name = "mlp"  # type: ignore[assignment]
    target_range: tuple[Tensor, Tensor]  # (low, high) in the training data

    def __init__(self, config: MLPConfig, dataset_meta: Any = None, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.inputs = [
            key for key in (STATE, ENVIRONMENT_STATE) if key in (config.input_features or {})
        ]
        if config.reads_text is None:
            tasks = getattr(dataset_meta, "tasks", None)
            config.reads_text = tasks is not None and len(tasks) > 1
        if config.scales and not config.scaled and dataset_meta is not None:
            reads = ENVIRONMENT_STATE in self.inputs or getattr(config, "aux_weight", 0) > 0
            config.scaled = self._offsets(offsets_of(dataset_meta.features if reads else {}))
        self._build(config)
        if dataset_meta is not None:
            self._learn_statistics(training_table(config, dataset_meta), dataset_meta)
            self.target_range = self.model.target_low.clone(), self.model.target_high.clone()

    @override
    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any]]:
        """Return the mean loss over a batch of columns (B, d), and an empty dict of metrics."""
        losses = self._row_losses(self.network_inputs(batch), batch)
        return losses.sum() / len(losses), {}

    @override
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return one action per row, (B, n): absolute, except for `ee_delta`, where it is the
        motion of the hand.
        """
        return self.model.act(self.network_inputs(batch))

    @override
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return a chunk of one action per row, (B, 1, n)."""
        return self.select_action(batch).unsqueeze(1)

    @override
    def reset(self) -> None:
        """Do nothing: the policy has no memory."""

    @override
    def get_optim_params(self) -> Any:
        return [{"params": list(self.parameters()), "fused": True}]

    def _build(self, config: MLPConfig) -> None:
        """Build the network, and drop the features that it does not use."""
        features = config.input_features or {}
        config.input_features = {key: features[key] for key in self.inputs}
        width = sum(features[key].shape[0] for key in self.inputs)
        width += LENGTH if config.reads_text else 0
        self.model = MLPNetwork(width, self._numbers_out(), config)

    def _numbers_out(self) -> int:
        """Return the number of values in an action."""
        return (self.config.output_features or {})[ACTION].shape[0]

    def _offsets(self, places: tuple[int, ...]) -> tuple[int, ...]:
        """Return the indices among the inputs of these numbers of the environment state."""
        n = (self.config.input_features or {})[STATE].shape[0]
        return tuple(n + place for place in places)

    def network_inputs(self, batch: dict[str, Tensor]) -> Tensor:
        """Return the network's inputs (B, d) for a batch of observations."""
        parts = [batch[key] for key in self.inputs]
        return torch.cat([*parts, *self.texts(batch)], dim=-1)

    def texts(self, batch: Mapping[str, Any]) -> list[Tensor]:
        """Return the network's inputs for the texts of a batch, one array (B, l); [] if it reads
        none.
        """
        if not self.config.reads_text:
            return []
        if TASK not in batch:
            raise UsageError("the policy reads the task's text, which is not given here")
        return [tokens(batch[TASK]).to(batch[STATE].device)]

    def _row_losses(self, inputs: Tensor, batch: dict[str, Tensor]) -> Tensor:
        return self.model.row_losses(inputs, batch[ACTION])

    def _learn_statistics(self, table: Table, dataset_meta: Any) -> None:
        """Compute the network's statistics from the labelled frames of a training table."""
        self.model.learn_statistics(*labelled(table, self.inputs))


def training_table(config: MLPConfig, dataset_meta: Any) -> Table:
    """Return the columns of the training data, (N, d) each.

    `manip-il train` has read them already (`dataset_meta.table`); for `lerobot-train` they are read
    here.

    Raises:
        ManipError: Only `manip-il train` converts to the action space.
    """
    if (table := getattr(dataset_meta, "table", None)) is not None:
        return table
    if config.action_space == EE_DELTA:
        raise ManipError(
            f"{EE_DELTA} needs the robot's kinematics, which LeRobot does not have; train with"
            " manip-il train"
        )
    return table_of(Dataset.open(dataset_meta.root))


def table_of(dataset: Dataset) -> Table:
    """Return what an mlp learns from, by column, (N, d) each, and `label_valid`, (N,)."""
    names = [key for key in (STATE, ENVIRONMENT_STATE, ACTION) if key in dataset.features]
    columns = dataset.columns(names)
    table = {key: column.reshape(len(column), -1) for key, column in columns.items()}
    return table | {LABEL_VALID: label_valid(dataset)}


def labelled(table: Table, inputs: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Return the joined columns `inputs`, (S, d), and the actions, (S, n), of the frames with a
    valid label.
    """
    valid = table[LABEL_VALID] != 0
    seen = np.concatenate([table[key][valid] for key in inputs], axis=1)
    return torch.from_numpy(seen).float(), torch.from_numpy(table[ACTION][valid]).float()


def offsets_of(features: Mapping[str, Any]) -> tuple[int, ...]:
    """Return the indices, in the environment state, of offsets between two things.

    Args:
        features: The `features` of the dataset's `info.json`.

    Raises:
        UsageError: There are no offsets.
    """
    names = features[ENVIRONMENT_STATE]["names"] if ENVIRONMENT_STATE in features else []
    found = tuple(i for i, name in enumerate(names) if "_from_" in name)
    if not found:
        raise UsageError(
            f"policy.scales needs offsets (..._from_...) among the inputs, which are {list(names)}"
        )
    return found


def make_mlp_pre_post_processors(
    config: MLPConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[PolicyProcessorPipeline[Any, Any], PolicyProcessorPipeline[Any, Any]]:
    """Return LeRobot's default preprocessor (rename, batch, device, normalise) and postprocessor.

    `config.normalization_mapping` makes the normaliser steps the identity. They stay in the
    pipelines because LeRobot's tools override them by name.
    """
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)
