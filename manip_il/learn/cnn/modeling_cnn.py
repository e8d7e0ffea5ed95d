"""The `cnn` policy: one action from joint state and the keypoints of every camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast, override

import torch
from torch import Tensor, nn

from manip_il.data.schema import ENVIRONMENT_STATE, STATE
from manip_il.learn.cnn.configuration_cnn import CNNConfig
from manip_il.learn.columns import INDEX, Table
from manip_il.learn.mlp.configuration_mlp import MLPConfig
from manip_il.learn.mlp.modeling_mlp import MLPPolicy
from manip_il.learn.network import MLPNetwork, fit_statistics

NUMBERS = 4  # a keypoint: x, y, spread, strength
_LIGHT, _COLOUR = 4.0, 16.0  # pictures differ in light much more than in colour; these make them alike
_SHARPNESS = 3.0  # of the softmax
_SPREAD, _STRENGTH = 4.0, 0.3  # bring both to about -2 to 2


class KeypointEncoder(nn.Module):
    """A few convolutions and a spatial softmax.

    (Levine et al., End-to-end training of deep visuomotor policies, JMLR 2016, section 5.1.) Every keypoint is a
    channel's softmax over the picture. Of it come the mean x and y, -1 to 1, finer than a pixel, and two numbers
    more: the deviation, which says how large a thing is and so how far away; and the mean activation, which says
    whether the thing is to be seen at all, as the softmax of nothing is a place too.

    A keypoint learns only from what it looks at, so some must begin on every small thing of a colour of its own.
    Hence the picture is split into light and colour, and the weights begin with variance 2 / inputs (He et al.,
    Delving deep into rectifiers, ICCV 2015, Eq. 10). With red, green and blue and torch's own weights every softmax
    began as the mean over the picture, and in 1,100 steps a goal of 5 pixels was not found; so it is in 300.

    channels: of the layers; the first two halve the picture's sides.
    """

    def __init__(self, channels: Sequence[int], keypoints: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for i, (inputs, outputs) in enumerate(zip((3, *channels[:-1]), channels, strict=True)):
            kernel = 5 if i == 0 else 3
            layers += [nn.Conv2d(inputs, outputs, kernel, stride=2 if i < 2 else 1, padding=kernel // 2), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.heat = nn.Conv2d(channels[-1], keypoints, 1)
        for layer in (*self.layers, self.heat):
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
        self.size = NUMBERS * keypoints

    def forward(self, pictures: Tensor) -> Tensor:
        """Return numbers of the keypoints, (B, 4 K) in single precision, from pictures (B, 3, H, W) from 0 to 1."""
        # Channels last is faster on a CPU. The weights stay contiguous, as safetensors wants an optimiser's state.
        features = self.layers(_light_and_colour(pictures).contiguous(memory_format=torch.channels_last))
        # In half precision a keypoint would jump from pixel to pixel.
        with torch.autocast(pictures.device.type, enabled=False):
            return self._keypoints(self.heat(features.float()))

    def _keypoints(self, heat: Tensor) -> Tensor:
        flat = heat.flatten(2)
        weights = (_SHARPNESS * flat).softmax(-1).view_as(heat)
        across, down = weights.sum(2), weights.sum(3)
        grid_x = torch.linspace(-1.0, 1.0, heat.shape[3], device=heat.device)
        grid_y = torch.linspace(-1.0, 1.0, heat.shape[2], device=heat.device)
        x, y = across @ grid_x, down @ grid_y
        variance = across @ grid_x.square() + down @ grid_y.square() - x.square() - y.square()
        spread = variance.clamp(min=1e-6).sqrt()
        strength = (weights.flatten(2) * flat).sum(-1)
        return torch.cat([x, y, _SPREAD * spread, _STRENGTH * strength], dim=-1)


def _perceptron(inputs: int, width: int, depth: int, outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for size in (inputs, *[width] * (depth - 1)):
        layers += [nn.Linear(size, width), nn.SiLU()]
    return nn.Sequential(*layers, nn.Linear(width, outputs))


def _light_and_colour(pictures: Tensor) -> Tensor:
    """Mean of red, green and blue, and what red and green have more than that, (B, 3, H, W)."""
    light = pictures.mean(1, keepdim=True)
    return torch.cat([_LIGHT * (light - 0.5), _COLOUR * (pictures[:, :2] - light)], dim=1)


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
        self.keypoint_size = sum(encoder.size for encoder in encoders)
        width = sum(features[key].shape[0] for key in self.inputs)
        self.seen_size, self.aux_weight = width + self.keypoint_size, config.aux_weight
        self.privileged: nn.Module | None = None
        self._read_off(config.privileged_size)
        self._privileged_by_index: Tensor | None = None

    def _read_off(self, size: int) -> None:
        """Make the perceptron that reads so many numbers off, and the one for the action, which gets them, too."""
        config = cast(CNNConfig, self.config)
        n = (config.input_features or {})[STATE].shape[0]
        if size:
            self.privileged = _perceptron(self.seen_size, config.width, config.depth, size)
        self.model = MLPNetwork(self.seen_size + size, n, config.network_shape())

    @override
    def _inputs(self, batch: dict[str, Tensor]) -> Tensor:
        keypoints = [encoder(batch[key]) for encoder, key in zip(self.encoders, self.cameras, strict=True)]
        seen = torch.cat([*(batch[key] for key in self.inputs), *keypoints], dim=-1)
        if self.privileged is None:
            return seen
        with torch.autocast(seen.device.type, enabled=False):
            width, config = self.seen_size, cast(CNNConfig, self.config)
            encoded = ((seen - self.model.input_mean[:width]) * self.model.input_scale[:width]).clamp(
                -config.clamp, config.clamp
            )
            return torch.cat([seen, self.privileged(encoded)], dim=-1)

    @override
    def _row_losses(self, inputs: Tensor, batch: dict[str, Tensor]) -> Tensor:
        with torch.autocast(inputs.device.type, enabled=False):
            losses = super()._row_losses(inputs, batch)
            privileged = self._privileged_by_index
            if not self.training or privileged is None or self.privileged is None or batch.get(INDEX) is None:
                return losses
            truth = privileged.to(inputs.device)[batch[INDEX].reshape(-1)]
            return losses + self.aux_weight * (inputs[:, self.seen_size :] - truth).abs().mean(-1)

    @override
    def _learn_columns(self, columns: Table, loss: str) -> None:
        reads = self.aux_weight > 0 and ENVIRONMENT_STATE in columns and ENVIRONMENT_STATE not in self.inputs
        size, config = columns[ENVIRONMENT_STATE].shape[1] if reads else 0, cast(CNNConfig, self.config)
        if reads and not config.privileged_size:
            config.privileged_size = size
            self._read_off(size)
        super()._learn_columns(columns, loss)
        if not reads or config.privileged_size != size:
            return  # a checkpoint from another task goes on without
        values, index = columns[ENVIRONMENT_STATE], torch.from_numpy(columns[INDEX])
        statistics = fit_statistics(values, values, "mse")
        known = torch.zeros(int(index.max()) + 1, size)
        known[index] = (torch.from_numpy(values) - statistics.input_mean) * statistics.input_scale
        self._privileged_by_index = known
