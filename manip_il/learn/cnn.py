"""The `cnn` policy in LeRobot's form: one action from joint state and the keypoints of every camera.

Options, policy and processors are in one module that LeRobot can treat as a package: see `manip_il.learn.mlp`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, override

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from torch import Tensor, nn
from torch.nn.functional import grid_sample, interpolate

from manip_il.data.dataset import UNKNOWN_TASK, Dataset, joined_columns
from manip_il.data.lerobot_layout import INDEX
from manip_il.data.schema import (
    ACTION,
    ENVIRONMENT_STATE,
    IMAGES,
    KEYPOINTS,
    LABEL_VALID,
    STATE,
    check_same_spec,
)
from manip_il.errors import UsageError, shorten
from manip_il.learn.checkpoint import MOST_VALUES
from manip_il.learn.mlp import MLPConfig, MLPPolicy, offsets_of
from manip_il.learn.mlp import make_mlp_pre_post_processors as make_cnn_pre_post_processors
from manip_il.learn.names import EE_DELTA, JOINT_DELTA
from manip_il.learn.network import MLPNetwork, Shape, fit_statistics, perceptron
from manip_il.learn.samples import Table, valid_frames
from manip_il.option import bounded, option

__all__ = ["CNNConfig", "CNNPolicy", "make_cnn_pre_post_processors"]
__path__: list[str] = []

NUMBERS = 4  # numbers per keypoint: x, y, spread, strength
_MOST_LAYERS = 16
STRIDE = 4  # distance between cells of the heat maps [pixels]
_LIGHT, _COLOUR = 4.0, 16.0  # pictures vary far more in brightness than in colour; these scales equalise them
_SHARPNESS = 3.0  # gain before the softmax
_SPREAD, _STRENGTH = 4.0, 0.3  # scale spread and strength to about -2 to 2
DRAWS = 16  # noisy true states per row of a batch, if `states` is given
MOST_NOISE = 2.0  # largest standard deviation of this noise, as a multiple of the prediction's mean error in training
_MEMORY = 0.99  # weight of the previous value in the running mean of that error


@PreTrainedConfig.register_subclass("cnn")
@dataclass
class CNNConfig(MLPConfig):
    """A small convolutional network that finds keypoints in every camera's picture, and the mlp's perceptron on top.

    channels: number in each convolutional layer; the first two layers halve the picture's sides, the others keep them.
    keypoints: number per camera. aux_weight: weight of the loss of a second perceptron, which predicts
    `observation.environment_state` from joints and keypoints if the dataset has it and it is not an input; the loss is
    the mean absolute error in standard deviations. The action is predicted from joints, keypoints and this predicted
    state; the true state is never used to act. scales: as in the mlp, but for the offsets in the environment state
    (predicted, or true if it is an input); scaled: their indices in that state. heatmap_weight: weight of the
    cross-entropy [nats] between heat maps and the positions of named points (`privileged.keypoints.<camera>`), each of
    which has a keypoint of its own in addition to `keypoints`; 0: off. states: a dataset without pictures. If given,
    the mlp's network predicts the action from joints and predicted state alone. It is trained on the true states of
    this dataset and of the frames with pictures, plus noise of the size of the prediction's error (the "independent"
    concept bottleneck of Koh et al., ICML 2020). All other options are the mlp's.

    On a CPU with bfloat16, `use_amp` trains the convolutions in half precision, which is twice as fast. Acting is
    always in single precision.

    Raises what `MLPConfig` raises, and `UsageError` for sizes and weights out of range.
    """

    channels: tuple[int, ...] = (16, 32, 32, 32)
    keypoints: int = option(32, "keypoints per camera", at_least=1, at_most=1024)
    aux_weight: float = option(0.5, "weight of the loss of the predicted state", at_least=0)
    heatmap_weight: float = option(0.0, "weight of the loss of the heat maps", at_least=0)
    states: str = option("", "dataset of states; the policy then acts on joints and predicted state alone")
    privileged_size: int = bounded(0, 0, MOST_VALUES)  # size of the predicted state; taken from the dataset
    named_points: int = bounded(0, 0, 1024)  # number of points with a heat map; taken from the dataset

    depth: int = 2
    loss: str = "l1"
    use_amp: bool = True
    scheduler_warmup_steps: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        self.channels = tuple(self.channels)
        if not 2 <= len(self.channels) <= _MOST_LAYERS or not 1 <= min(self.channels) <= max(self.channels) <= 1024:
            raise UsageError(
                f"policy.channels is {shorten(list(self.channels))}; expected 2 to {_MOST_LAYERS} layers, "
                "of 1 to 1,024 channels each"
            )

    @override
    def validate_features(self) -> None:
        """Raise unless there are `observation.state`, `action` of the same size, and pictures."""
        super().validate_features()
        if self.states and self.action_space == EE_DELTA:
            raise UsageError(f"policy.states cannot be combined with {EE_DELTA}; expected {JOINT_DELTA}")
        if not self.image_features:
            have = ", ".join(self.input_features or {})
            raise UsageError(f"the cnn policy needs pictures (observation.images.*); the inputs are {have}")


class CNNPolicy(MLPPolicy):
    """LeRobot's policy interface to one `KeypointEncoder` per camera and an `MLPNetwork` on joints and keypoints.

    Batches hold the same columns as the mlp's (`observation.environment_state` only if it is an input) and
    `observation.images.<camera>` (B, 3, H, W), from 0 to 1. Pictures that are larger than in training, as those of
    `lerobot-eval` may be, are reduced to that size by averaging.

    dataset_meta: as for the mlp. In training, the environment state is also predicted from the keypoints
    (`CNNConfig.aux_weight`), and named points of the scene have heat maps (`heatmap_weight`); each frame's ground truth
    is looked up by the batch's `index`.
    """

    config_class = CNNConfig  # type: ignore[assignment]
    name = "cnn"  # type: ignore[assignment]
    truth_mean: Tensor
    truth_scale: Tensor
    error: Tensor

    @override
    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return one action per row, (B, n), as `MLPPolicy` does; bit-identical whatever the other rows are."""
        state = batch[STATE]
        if len(state) == 0:
            return torch.empty_like(state)
        # The last bits of a convolution depend on the batch size, so one row at a time. Half precision is for training.
        with torch.autocast(state.device.type, enabled=False):
            keys = (*self.inputs, *self.cameras)
            rows = [self.network_inputs({key: batch[key][i : i + 1] for key in keys}) for i in range(len(state))]
            return self.model.act(torch.cat(rows))

    @override
    def _build(self, config: MLPConfig) -> None:
        config = cast(CNNConfig, config)
        features = config.input_features or {}
        self.cameras = sorted(config.image_features)
        config.input_features = {key: features[key] for key in (*self.inputs, *self.cameras)}
        self._by_index: dict[str, Tensor] = {}  # values of every frame of the data, by its `index`
        self._table: tuple[Tensor, ...] = ()  # joints, true state and action of every labelled frame
        self.privileged: nn.Module | None = None
        self.aux_weight, self.heatmap_weight = config.aux_weight, config.heatmap_weight
        self._make(config)

    def _make(self, config: CNNConfig) -> None:
        """Build the encoders, the perceptron that predicts the state and the one that predicts the action."""
        features, size = config.input_features or {}, config.privileged_size
        n = features[STATE].shape[0]
        count, named = config.named_points + config.keypoints, config.named_points > 0
        encoders = [KeypointEncoder(config.channels, count, keeps_maps=named) for _ in self.cameras]
        self.encoders = nn.ModuleList(encoders)
        self.seen_size = sum(features[key].shape[0] for key in self.inputs) + sum(one.size for one in encoders)
        self.privileged = None
        if size:
            self.privileged = perceptron(self.seen_size, config.width, config.depth, size, nn.SiLU)
            self.register_buffer("truth_mean", torch.zeros(size))
            self.register_buffer("truth_scale", torch.ones(size))
        self.offsets = list(config.scaled) if size or ENVIRONMENT_STATE in self.inputs else []
        if config.states:
            self.register_buffer("error", torch.zeros(size))  # mean absolute error of the predicted state in training
            shape = Shape.of(vars(config) | {"scaled": tuple(n + i for i in self.offsets)})
            self.model = MLPNetwork(n + size, n, shape)
        else:
            shape = Shape.of(vars(config) | {"scales": (), "scaled": ()})  # the cnn scales the offsets itself
            self.model = MLPNetwork(self.seen_size + size + len(config.scales) * len(self.offsets), n, shape)

    @override
    def network_inputs(self, batch: dict[str, Tensor]) -> Tensor:
        """Return the action network's inputs, (B, d): measured inputs, keypoints, predicted state, scaled offsets.

        With the option `states`, return only joint state and predicted state.
        """
        keypoints = [
            encoder(self._at_size(key, batch)) for encoder, key in zip(self.encoders, self.cameras, strict=True)
        ]
        seen = torch.cat([*(batch[key] for key in self.inputs), *keypoints], dim=-1)
        parts = [seen]
        around = batch.get(ENVIRONMENT_STATE)
        config = cast(CNNConfig, self.config)
        with torch.autocast(seen.device.type, enabled=False):
            if self.privileged is not None:
                n = batch[STATE].shape[1]
                joints = (batch[STATE] - self.model.input_mean[:n]) * self.model.input_scale[:n]
                encoded = torch.cat([joints, seen[:, n:]], dim=-1).clamp(-config.clamp, config.clamp)
                parts.append(self.privileged(encoded))
                varies = self.truth_scale > 0
                deviation = torch.where(varies, 1.0 / self.truth_scale, torch.zeros_like(self.truth_scale))
                around = self.truth_mean + deviation * parts[1]
                if config.states:
                    return torch.cat([batch[STATE], around], dim=-1)
            if around is not None and self.offsets:
                parts += [torch.tanh(around[:, self.offsets] / scale) for scale in config.scales]
            return torch.cat(parts, dim=-1)

    def _at_size(self, key: str, batch: dict[str, Tensor]) -> Tensor:
        """Return a camera's pictures (B, 3, H, W) at the size used in training, reduced by averaging if larger."""
        size = tuple((self.config.input_features or {})[key].shape[1:])
        return batch[key] if batch[key].shape[2:] == size else interpolate(batch[key], size, mode="area")

    @override
    def _row_losses(self, inputs: Tensor, batch: dict[str, Tensor]) -> Tensor:
        with torch.autocast(inputs.device.type, enabled=False):
            truth = self._of_frames(ENVIRONMENT_STATE, batch) if self.training else None
            if truth is not None and cast(CNNConfig, self.config).states:
                errors = (inputs[:, -truth.shape[1] :] - truth).abs()
                losses = self._losses_of_states(errors.detach())
                losses = losses + self.aux_weight * (errors * self.truth_scale).mean(-1)
            else:
                losses = super()._row_losses(inputs, batch)
                if truth is not None:
                    wanted = (truth - self.truth_mean) * self.truth_scale
                    read_off = inputs[:, self.seen_size : self.seen_size + wanted.shape[1]]
                    losses = losses + self.aux_weight * (read_off - wanted).abs().mean(-1)
            if self.training and (places := self._of_frames(KEYPOINTS, batch)) is not None:
                losses = losses + self.heatmap_weight * self._heat_map_losses(places)
            return losses

    def _losses_of_states(self, errors: Tensor) -> Tensor:
        """Return the action network's mean loss on `DRAWS` noisy true states for each row, (B,).

        errors: absolute errors of the predicted state in this batch, (B, k), in the state's units.
        """
        self.error.lerp_(errors.mean(0), 1.0 - _MEMORY if self.error.any() else 1.0)
        rows = torch.randint(len(self._table[0]), (DRAWS * len(errors),))
        joints, truth, actions = (one[rows].to(errors.device) for one in self._table)
        noise = MOST_NOISE * torch.rand(len(rows), 1, device=errors.device) * self.error * torch.randn_like(truth)
        inputs = torch.cat([joints, truth + noise], dim=-1)
        targets = self.model.encode_targets(self.model.relative(actions, inputs))
        return self.model.row_losses(self.model.encode(inputs), targets).view(len(errors), DRAWS).mean(1)

    def _of_frames(self, name: str, batch: dict[str, Tensor]) -> Tensor | None:
        """Return the values stored for a batch's frames, (B, ...), by the batch's `index`; None if there are none."""
        if name not in self._by_index or batch.get(INDEX) is None:
            return None
        return self._by_index[name][batch[INDEX].reshape(-1).cpu()].to(batch[STATE].device)

    def _remember(self, name: str, columns: Table, values: Tensor) -> None:
        """Store, under `name`, the values (N, ...) of all frames of the data."""
        index = torch.from_numpy(columns[INDEX].reshape(-1))
        self._by_index[name] = values.new_zeros((int(index.max()) + 1, *values.shape[1:]))
        self._by_index[name][index] = values

    def _heat_map_losses(self, places: Tensor) -> Tensor:
        """Return each row's loss, averaged over the cameras, (B,). places: (B, cameras, K, 3)."""
        shapes = [self.config.image_features[key].shape[1:] for key in self.cameras]
        found = []
        for encoder, at, shape in zip(self.encoders, places.unbind(1), shapes, strict=True):
            if (maps := cast(KeypointEncoder, encoder).maps) is not None:
                found.append(heat_map_losses(maps[:, : at.shape[1]], at.to(maps.device), shape))
        return torch.stack(found).mean(0)

    @override
    def _offsets(self, config: MLPConfig, features: Any) -> tuple[int, ...]:
        """Return the indices of the offsets in the environment state, if that is an input or is predicted."""
        reads = ENVIRONMENT_STATE in self.inputs or cast(CNNConfig, config).aux_weight > 0
        return offsets_of(features if reads else {})

    @override
    def _more_columns(self) -> Sequence[str]:
        """Return the names of the columns of the true state and, if heat maps are trained, of the named points."""
        return [ENVIRONMENT_STATE, *self._place_columns()]

    @override
    def _columns(self, config: MLPConfig, dataset_meta: Any) -> Table:
        if states := cast(CNNConfig, config).states:
            pictures = self._roots(dataset_meta)[0]
            found, own = (Dataset.open(Path(root).expanduser()).spec for root in (states, pictures))
            also = () if UNKNOWN_TASK in (found.task, own.task) else ("task",)
            check_same_spec(states, found, str(pictures), own, also)
        return super()._columns(config, dataset_meta)

    def _place_columns(self) -> list[str]:
        return [key.replace(IMAGES, KEYPOINTS) for key in self.cameras] if self.heatmap_weight else []

    @override
    def _learn_columns(self, columns: Table) -> None:
        config = cast(CNNConfig, self.config)
        truth = self._truth(columns)
        places = self._places(columns)
        sizes = 0 if truth is None else truth.shape[1], 0 if places is None else places.shape[2]
        if not config.privileged_size and not config.named_points and any(sizes):
            config.privileged_size, config.named_points = sizes
            self._make(config)
        if config.states:
            self._learn_states(columns, truth, Path(config.states).expanduser())
        else:
            super()._learn_columns(columns)
        if truth is not None and config.privileged_size == sizes[0]:  # else the checkpoint is from another task
            statistics = fit_statistics(truth.numpy(), truth.numpy(), "mse")
            self.truth_mean.copy_(statistics["input_mean"])
            self.truth_scale.copy_(statistics["input_scale"])
            self._remember(ENVIRONMENT_STATE, columns, truth)
        if places is not None and config.named_points == sizes[1]:
            self._remember(KEYPOINTS, columns, places)

    def _learn_states(self, columns: Table, truth: Tensor | None, more: Path) -> None:
        """Compute the action network's statistics from joints and true state, and keep all labelled states.

        more: folder of the dataset of states.
        """
        if truth is None:
            raise UsageError("policy.states needs a dataset with observation.environment_state, and aux_weight > 0")
        table = joined_columns([more], [STATE, ENVIRONMENT_STATE, ACTION, LABEL_VALID])
        table[ENVIRONMENT_STATE] = table[ENVIRONMENT_STATE].reshape(-1, truth.shape[1])
        self._table = tuple(
            torch.cat(
                [torch.from_numpy(one[key])[torch.from_numpy(valid_frames(one))].float() for one in (columns, table)]
            )
            for key in (STATE, ENVIRONMENT_STATE, ACTION)
        )
        joints, states, actions = self._table
        inputs = torch.cat([joints, states], dim=1)
        targets = self.model.relative(actions, inputs).numpy()
        self.model.set_statistics(fit_statistics(self.model.expanded(inputs).numpy(), targets, self.model.loss))

    def _truth(self, columns: Table) -> Tensor | None:
        """Return the environment state, (N, k), if it is to be predicted."""
        if not self.aux_weight or ENVIRONMENT_STATE not in columns or ENVIRONMENT_STATE in self.inputs:
            return None
        return torch.from_numpy(columns[ENVIRONMENT_STATE].astype(np.float32))

    def _places(self, columns: Table) -> Tensor | None:
        """Return positions of named points in every camera's picture, (N, cameras, K, 3), if heat maps are trained.

        Raises `UsageError` for a dataset without them.
        """
        keys = self._place_columns()
        if not keys:
            return None
        if missing := [key for key in keys if key not in columns]:
            raise UsageError(
                f"policy.heatmap_weight is {self.heatmap_weight:g}, but the dataset has no {missing[0]}; "
                "manip-il data redraw and manip-il data render write it"
            )
        found = np.stack([np.asarray(columns[key], np.float32) for key in keys], axis=1)
        return torch.from_numpy(found).unflatten(2, (-1, 3))


class KeypointEncoder(nn.Module):
    """A few convolutions and a spatial softmax.

    (Levine et al., End-to-end training of deep visuomotor policies, JMLR 2016, section 5.1.) Every keypoint is the
    softmax of one channel over the picture. It yields the mean x and y, -1 to 1, with subpixel resolution, and two more
    numbers: the deviation, which indicates the size of a thing and hence its distance, and the mean activation, which
    says whether the thing is visible at all, as the softmax of an empty picture has a mean, too.

    A keypoint learns only where its softmax is large, so some must start on every small thing of a distinct colour.
    Hence the picture is split into brightness and colour, and the weights start with variance 2 / inputs (He et al.,
    Delving deep into rectifiers, ICCV 2015, Eq. 10). With red, green and blue and torch's own initialisation
    every softmax began nearly uniform, and a goal of 5 pixels was not found in 1,100 steps; now 300 suffice.

    channels: number in each layer; the first two layers halve the picture's sides. keeps_maps: whether `maps` holds the
    logarithms of the last pictures' heat maps, (B, K, height, width), while training.
    """

    maps: Tensor | None = None

    def __init__(self, channels: Sequence[int], keypoints: int, *, keeps_maps: bool = False) -> None:
        super().__init__()
        self.keeps_maps = keeps_maps
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
        """Return the numbers of the keypoints, (B, 4 K) in single precision, for pictures (B, 3, H, W) from 0 to 1."""
        # Channels-last is faster on a CPU. The weights stay contiguous, as safetensors needs for an optimiser's state.
        features = self.layers(_light_and_colour(pictures).contiguous(memory_format=torch.channels_last))
        # In half precision a keypoint would jump from pixel to pixel.
        with torch.autocast(pictures.device.type, enabled=False):
            return self._keypoints(features.float())

    def _keypoints(self, features: Tensor) -> Tensor:
        """Return the numbers of the keypoints, (B, 4 K), from features (B, C, height, width)."""
        height, width = features.shape[2:]
        # A 1 x 1 convolution as a matrix product, whose result is laid out in memory for the softmax.
        cells = features.permute(0, 2, 3, 1).flatten(1, 2).transpose(1, 2)  # (B, C, cells), without a copy
        heat = self.heat.weight.flatten(1) @ cells + self.heat.bias.unsqueeze(1)  # type: ignore[union-attr]
        weights = (_SHARPNESS * heat).softmax(-1)
        if self.training and self.keeps_maps:
            self.maps = (_SHARPNESS * heat).log_softmax(-1).unflatten(-1, (height, width))
        moments = weights @ _places(height, width, heat.device)
        x, y = moments[..., 0], moments[..., 1]
        variance = moments[..., 2] - x.square() - y.square()
        spread = variance.clamp(min=1e-6).sqrt()
        strength = (weights * heat).sum(-1)
        return torch.cat([x, y, _SPREAD * spread, _STRENGTH * strength], dim=-1)


def _places(height: int, width: int, device: torch.device) -> Tensor:
    """Return x, y and x^2 + y^2 of every cell of a heat map, row by row, (height width, 3)."""
    x = torch.linspace(-1.0, 1.0, width, device=device).repeat(height)
    y = torch.linspace(-1.0, 1.0, height, device=device).repeat_interleave(width)
    return torch.stack([x, y, x.square() + y.square()], dim=1)


def heat_map_losses(maps: Tensor, places: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return the mean cross-entropy [nats] of the visible points, (B,), 0 if none is visible.

    maps: logarithms of heat maps (B, K, height, width), whose cells are `STRIDE` pixels apart, starting at the first
    pixel. places: x and y from 0 to 1, and whether the point is visible, (B, K, 3); a point between cells is shared
    among the four around it by bilinear weights. shape: height and width of the pictures.
    """
    size = torch.tensor([maps.shape[3], maps.shape[2]], device=maps.device)
    at = (places[..., :2] * torch.tensor([shape[1], shape[0]], device=maps.device) - 0.5) / STRIDE
    grid = 2 * at / (size - 1) - 1  # from -1 at the first cell's centre to 1 at the last one's
    each = maps.flatten(0, 1).unsqueeze(1), grid.view(-1, 1, 1, 2)
    found = grid_sample(*each, padding_mode="border", align_corners=True).view(places.shape[:2])
    seen = places[..., 2]
    return -(found * seen).sum(1) / seen.sum(1).clamp(min=1)


def _light_and_colour(pictures: Tensor) -> Tensor:
    """Return the mean of red, green and blue, and red and green minus that mean, (B, 3, H, W)."""
    light = pictures.mean(1, keepdim=True)
    return torch.cat([_LIGHT * (light - 0.5), _COLOUR * (pictures[:, :2] - light)], dim=1)
