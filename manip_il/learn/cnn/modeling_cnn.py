"""The `cnn` policy: one action from joint state and pictures."""

from __future__ import annotations

from typing import Any, cast, override

import torch
from torch import Tensor, nn

from manip_il.data.schema import ENVIRONMENT_STATE, STATE
from manip_il.learn.cnn.configuration_cnn import CNNConfig
from manip_il.learn.cnn.encoder import KeypointEncoder
from manip_il.learn.columns import INDEX, Table
from manip_il.learn.mlp.configuration_mlp import MLPConfig
from manip_il.learn.mlp.modeling_mlp import MLPPolicy
from manip_il.learn.network import MLPNetwork
from manip_il.learn.normalise import fit_statistics


class CNNPolicy(MLPPolicy):
    """LeRobot's policy interface to a `KeypointEncoder` a camera and an `MLPNetwork` on joints and keypoints.

    Batches hold what the mlp's do (`observation.environment_state` where it is an input) and
    `observation.images.<camera>` (B, 3, H, W), from 0 to 1.

    dataset_meta: as for the mlp. While training, the state of the environment is then read off the keypoints
    too (`CNNConfig.aux_weight`), each frame's known by the batch's `index`.
    """

    config_class = CNNConfig  # type: ignore[assignment]
    name = "cnn"  # type: ignore[assignment]

    @override
    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return one absolute action a row, (B, n), each the same bits whatever the other rows are."""
        state = batch[STATE]
        if len(state) == 0:
            return torch.empty_like(state)
        # A convolution's sums depend on the number of pictures: one row at a time. Half precision is for learning.
        with torch.autocast(state.device.type, enabled=False):
            keys = (*self.inputs, *self.cameras)
            rows = [self._inputs({key: batch[key][i : i + 1] for key in keys}) for i in range(len(state))]
            return self.model.act(torch.cat(rows))

    @override
    def _build(self, config: MLPConfig) -> None:
        config = cast(CNNConfig, config)
        features = config.input_features or {}
        self.cameras = sorted(config.image_features)
        config.input_features = {key: features[key] for key in (*self.inputs, *self.cameras)}
        encoders = [KeypointEncoder(config.channels, config.keypoints) for _ in self.cameras]
        self.encoders = nn.ModuleList(encoders)
        self.seen = sum(encoder.size for encoder in encoders)
        width = sum(features[key].shape[0] for key in self.inputs)
        self.model = MLPNetwork(width + self.seen, features[STATE].shape[0], config.network_shape())
        self.privileged = nn.Linear(self.seen, config.privileged_size) if config.privileged_size else None
        self.aux_weight = config.aux_weight
        self._privileged_by_index: Tensor | None = None

    @override
    def _inputs(self, batch: dict[str, Tensor]) -> Tensor:
        seen = [encoder(batch[key]) for encoder, key in zip(self.encoders, self.cameras, strict=True)]
        return torch.cat([*(batch[key] for key in self.inputs), *seen], dim=-1)

    @override
    def _row_losses(self, inputs: Tensor, batch: dict[str, Tensor]) -> Tensor:
        with torch.autocast(inputs.device.type, enabled=False):
            losses = super()._row_losses(inputs, batch)
            privileged = self._privileged_by_index
            if not self.training or privileged is None or self.privileged is None or batch.get(INDEX) is None:
                return losses
            truth = privileged.to(inputs.device)[batch[INDEX].reshape(-1)]
            return losses + self.aux_weight * (self.privileged(inputs[:, -self.seen :]) - truth).abs().mean(-1)

    @override
    def _learn_columns(self, columns: Table, loss: str) -> None:
        super()._learn_columns(columns, loss)
        if self.aux_weight > 0 and ENVIRONMENT_STATE in columns and ENVIRONMENT_STATE not in self.inputs:
            self._learn_privileged(columns)

    def _learn_privileged(self, columns: Table) -> None:
        values, index = columns[ENVIRONMENT_STATE], torch.from_numpy(columns[INDEX])
        size = values.shape[1]
        if self.privileged is None:
            cast(CNNConfig, self.config).privileged_size = size
            self.privileged = nn.Linear(self.seen, size)
        if self.privileged.out_features != size:
            return  # a checkpoint from another task goes on without
        statistics = fit_statistics(values, values, "mse")
        known = torch.zeros(int(index.max()) + 1, size)
        known[index] = (torch.from_numpy(values) - statistics.input_mean) * statistics.input_scale
        self._privileged_by_index = known
