"""The `mlp` policy: one action from joint and environment state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast, override

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from numpy.typing import NDArray
from torch import Tensor

from manip_il.data.dataset import joined_columns
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, LABEL_VALID, STATE
from manip_il.errors import ManipError
from manip_il.learn.action_spaces import JointTarget, conversion
from manip_il.learn.columns import INDEX, Table, learning_rows, valid_frames
from manip_il.learn.fit_config import EE_DELTA
from manip_il.learn.mlp.configuration_mlp import MLPConfig
from manip_il.learn.network import MLPNetwork, fit_statistics


class MLPPolicy(PreTrainedPolicy):
    """LeRobot's policy interface to `MLPNetwork`.

    Batches hold `observation.state` (B, n), `observation.environment_state` (B, k) and, to learn,
    `action` (B, n), all raw ([rad], [m]).

    dataset_meta: LeRobot's, given by `make_policy` for training, or ours of several; the statistics are then those of
    its columns, and frames without a valid label are left out of the loss.
    """

    config_class = MLPConfig  # type: ignore[assignment]
    name = "mlp"  # type: ignore[assignment]

    def __init__(self, config: MLPConfig, dataset_meta: Any = None, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.inputs = [key for key in (STATE, ENVIRONMENT_STATE) if key in (config.input_features or {})]
        self._build(config)
        self._valid_by_index: Tensor | None = None
        if dataset_meta is not None:
            roots = getattr(dataset_meta, "roots", None) or (dataset_meta.root,)
            wanted = (STATE, ENVIRONMENT_STATE, ACTION, LABEL_VALID, *self._more_columns())
            names = [key for key in wanted if key in dataset_meta.features]
            table = joined_columns(roots, [*names, INDEX])
            if config.action_space == EE_DELTA:
                table[ACTION] = _converted(dataset_meta)
            self._learn_columns(table, config.loss)

    @override
    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, Any]]:
        """Return the mean loss of rows with a valid label; with `reduction="none"` each row's, (B,), 0 without one."""
        losses = self._row_losses(self._inputs(batch), batch)
        valid = self._valid(batch)
        # `where`, as 0 * inf is NaN
        losses = losses if valid is None else torch.where(valid, losses, torch.zeros_like(losses))
        if reduction == "none":
            return losses, {}
        count = len(losses) if valid is None else valid.sum().clamp(min=1)
        return losses.sum() / count, {}

    @override
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return one action a row, (B, n): absolute, but of `ee_delta` the motion of the hand."""
        return self.model.act(self._inputs(batch))

    @override
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return a chunk of one action a row, (B, 1, n)."""
        return self.select_action(batch).unsqueeze(1)

    @override
    def reset(self) -> None:
        """Forget nothing: the policy has no memory."""

    @override
    def get_optim_params(self) -> Any:
        return self.parameters()

    def _more_columns(self) -> Sequence[str]:
        """Columns that learning looks at beside the mlp's."""
        return ()

    def _build(self, config: MLPConfig) -> None:
        """Make the network, and leave out the features that it does not look at."""
        features = config.input_features or {}
        config.input_features = {key: features[key] for key in self.inputs}
        width = sum(features[key].shape[0] for key in self.inputs)
        self.model = MLPNetwork(width, features[STATE].shape[0], config.network_shape())

    def _row_losses(self, inputs: Tensor, batch: dict[str, Tensor]) -> Tensor:
        targets = self.model.encode_targets(self.model.relative(batch[ACTION], inputs))
        return self.model.row_losses(self.model.encode(inputs), targets)

    def _inputs(self, batch: dict[str, Tensor]) -> Tensor:
        return torch.cat([batch[key] for key in self.inputs], dim=-1)

    def _valid(self, batch: dict[str, Tensor]) -> Tensor | None:
        if LABEL_VALID in batch:
            return batch[LABEL_VALID].reshape(-1) != 0
        # LeRobot's preprocessor drops columns that it does not know; `index` is one that it keeps.
        if self._valid_by_index is not None and batch.get(INDEX) is not None:
            index = batch[INDEX].reshape(-1)
            return self._valid_by_index.to(index.device)[index]
        return None

    def _learn_columns(self, columns: Table, loss: str) -> None:
        """Take statistics and valid labels from a dataset's columns."""
        space = cast(MLPConfig, self.config).action_space
        rows = learning_rows(
            {key: columns[key] for key in (*self.inputs, ACTION, LABEL_VALID) if key in columns},
            JointTarget() if space == EE_DELTA else conversion(space, ""),  # hand motions are converted already
        )
        self.model.set_statistics(fit_statistics(rows.inputs, rows.targets, loss))
        valid = torch.zeros(int(columns[INDEX].max()) + 1, dtype=torch.bool)
        valid[torch.from_numpy(columns[INDEX])] = torch.from_numpy(valid_frames(columns))
        self._valid_by_index = valid


def _converted(dataset_meta: Any) -> NDArray[np.float32]:
    """The dataset's actions as motions of the hand, (N, n), which `PolicyTrainer` leaves with the metadata."""
    if (actions := getattr(dataset_meta, "learnt_actions", None)) is None:
        raise ManipError(f"{EE_DELTA} needs the robot's kinematics, which LeRobot has not: train with manip-il train")
    return actions
