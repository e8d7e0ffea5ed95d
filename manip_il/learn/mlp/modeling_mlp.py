"""The `mlp` policy: one action from joint and environment state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, override

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from manip_il.data.dataset import joined_columns
from manip_il.data.lerobot_layout import INDEX
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, LABEL_VALID, STATE
from manip_il.errors import ManipError
from manip_il.learn.action_spaces import ARM, GRIPPER
from manip_il.learn.mlp.configuration_mlp import MLPConfig
from manip_il.learn.names import EE_DELTA
from manip_il.learn.network import MLPNetwork, fit_statistics
from manip_il.learn.samples import Table, valid_frames


class MLPPolicy(PreTrainedPolicy):
    """LeRobot's policy interface to `MLPNetwork`.

    Batches hold `observation.state` (B, n), `observation.environment_state` (B, k) and, to learn,
    `action` (B, n), all raw ([rad], [m]).

    dataset_meta: LeRobot's, given by `make_policy` for training, or with a `table` of the columns; the statistics are
    then theirs, and frames without a valid label are left out of the loss.
    """

    config_class = MLPConfig  # type: ignore[assignment]
    name = "mlp"  # type: ignore[assignment]

    def __init__(self, config: MLPConfig, dataset_meta: Any = None, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.inputs = [key for key in (STATE, ENVIRONMENT_STATE) if key in (config.input_features or {})]
        self._by_index: dict[str, Tensor] = {}  # of every frame of the data, by its `index`
        self._build(config)
        if dataset_meta is not None:
            self._learn_columns(self._columns(config, dataset_meta))

    @override
    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, Any]]:
        """Return the mean loss of rows with a valid label; with `reduction="none"` each row's, (B,), 0 without one.

        When it does not train, the mean absolute errors of acting, too: of the arm [rad] and the gripper [m].
        """
        inputs = self.network_inputs(batch)
        losses, valid = self._row_losses(inputs, batch), self._of_frames(LABEL_VALID, batch)
        # `where`, as 0 * inf is NaN
        losses = losses if valid is None else torch.where(valid, losses, torch.zeros_like(losses))
        if reduction == "none":
            return losses, {}
        count = len(losses) if valid is None else valid.sum().clamp(min=1)
        return losses.sum() / count, {} if self.training else self._errors(inputs.detach(), batch)

    @override
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return one action a row, (B, n): absolute, but of `ee_delta` the motion of the hand."""
        return self.model.act(self.network_inputs(batch))

    @override
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return a chunk of one action a row, (B, 1, n)."""
        return self.select_action(batch).unsqueeze(1)

    @override
    def reset(self) -> None:
        """Forget nothing: the policy has no memory."""

    @override
    def get_optim_params(self) -> Any:
        return [{"params": list(self.parameters()), "fused": True}]

    def _build(self, config: MLPConfig) -> None:
        """Make the network, and leave out the features that it does not look at."""
        features = config.input_features or {}
        config.input_features = {key: features[key] for key in self.inputs}
        width = sum(features[key].shape[0] for key in self.inputs)
        self.model = MLPNetwork(width, features[STATE].shape[0], config.network_shape())

    def _row_losses(self, inputs: Tensor, batch: dict[str, Tensor]) -> Tensor:
        targets = self.model.encode_targets(self.model.relative(batch[ACTION], inputs))
        return self.model.row_losses(self.model.encode(inputs), targets)

    def _errors(self, inputs: Tensor, batch: dict[str, Tensor]) -> dict[str, float]:
        error = (self.model.act(inputs) - batch[ACTION]).abs().mean(0)
        return {"arm_error": error[ARM].mean().item(), "gripper_error": error[GRIPPER].item()}

    def network_inputs(self, batch: dict[str, Tensor]) -> Tensor:
        """Return the network's inputs (B, d) of a batch of observations."""
        return torch.cat([batch[key] for key in self.inputs], dim=-1)

    def _of_frames(self, name: str, batch: dict[str, Tensor]) -> Tensor | None:
        """What is known of the frames of a batch, (B, ...): of these LeRobot's preprocessor keeps `index` alone."""
        if name not in self._by_index or batch.get(INDEX) is None:
            return None
        return self._by_index[name][batch[INDEX].reshape(-1).cpu()].to(batch[STATE].device)

    def _remember(self, name: str, columns: Table, values: Tensor) -> None:
        """Keep values (N, ...) of all frames of the data."""
        index = torch.from_numpy(columns[INDEX].reshape(-1))
        self._by_index[name] = values.new_zeros((int(index.max()) + 1, *values.shape[1:]))
        self._by_index[name][index] = values

    def _columns(self, config: MLPConfig, dataset_meta: Any) -> Table:
        """The columns of the data that is learnt from; those that nobody has read yet are read."""
        table = dict(getattr(dataset_meta, "table", {}))
        if config.action_space == EE_DELTA and not table:
            raise ManipError(
                f"{EE_DELTA} needs the robot's kinematics, which LeRobot has not: train with manip-il train"
            )
        wanted = [key for key in (*self.inputs, ACTION, LABEL_VALID, *self._more_columns()) if key not in table]
        if names := [key for key in wanted if key in dataset_meta.features]:
            roots = getattr(dataset_meta, "roots", ()) or (dataset_meta.root,)
            table |= joined_columns(roots, [*names, INDEX])
        return table

    def _more_columns(self) -> Sequence[str]:
        """Columns that learning looks at beside the mlp's."""
        return ()

    def _learn_columns(self, columns: Table) -> None:
        """Take statistics and valid labels from a dataset's columns."""
        valid = torch.from_numpy(valid_frames(columns))
        seen = torch.cat([torch.from_numpy(columns[key])[valid] for key in self.inputs], dim=1).float()
        actions = torch.from_numpy(columns[ACTION])[valid].float()
        targets = self.model.relative(actions, seen)
        self.model.set_statistics(fit_statistics(seen.numpy(), targets.numpy(), self.model.loss))
        self._remember(LABEL_VALID, columns, valid)
