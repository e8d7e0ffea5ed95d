"""The `cnn` policy in LeRobot's form: one action from joint state and the keypoints of every
camera.

Options, policy and processors are in one module that LeRobot can treat as a package: see
`manip_il.learn.mlp`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, override

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from torch import Tensor, nn
from torch.nn.functional import interpolate

from manip_il.data.dataset import UNKNOWN_TASK, Dataset
from manip_il.data.schema import ENVIRONMENT_STATE, STATE, check_same_spec
from manip_il.errors import UsageError, shorten
from manip_il.learn.checkpoint import MOST_VALUES
from manip_il.learn.mlp import MLPConfig, MLPPolicy, labelled, table_of
from manip_il.learn.mlp import make_mlp_pre_post_processors as make_cnn_pre_post_processors
from manip_il.learn.names import EE_DELTA, JOINT_DELTA
from manip_il.learn.network import MLPNetwork, NetworkConfig, fit_statistics, inverse, perceptron
from manip_il.learn.samples import TASK, Table
from manip_il.learn.texts import LENGTH, TextReader
from manip_il.option import bounded, option

_MOST_LAYERS = 16
__all__ = ["CNNConfig", "CNNPolicy", "make_cnn_pre_post_processors"]
__path__: list[str] = []

NUMBERS = 4  # numbers per keypoint: x, y, spread, strength
# pictures vary far more in brightness than in colour; these scales equalise them
_LIGHT, _COLOUR = 4.0, 16.0
_SHARPNESS = 3.0  # gain before the softmax
_SPREAD, _STRENGTH = 4.0, 0.3  # scale spread and strength to about -2 to 2
DRAWS = 16  # noisy true states per row of a batch, if `states` is given
# largest standard deviation of this noise, as a multiple of the prediction's mean error in training
MOST_NOISE = 2.0
_MEMORY = 0.99  # weight of the previous value in the running mean of that error


@PreTrainedConfig.register_subclass("cnn")
@dataclass
class CNNConfig(MLPConfig):
    """A small convolutional network that finds keypoints in every camera's picture, and the mlp's
    perceptron on top.

    On a CPU with bfloat16, `use_amp` trains the convolutions in half precision, which is twice as
    fast. Acting is always in single precision. All options that are not listed are the mlp's.

    Args:
        channels: Number in each convolutional layer; the first layer divides the picture's sides
            by `stride`, the second one halves them, the others keep them.
        stride: Pixels between neighbouring windows of the first layer, whose sides are
            2 * stride + 1; 4 for pictures of 192 pixels.
        keypoints: Number per camera.
        aux_weight: Weight of the loss of a second perceptron, which predicts
            `observation.environment_state` from joints and keypoints if the dataset has it and it
            is not an input. The loss is the mean absolute error in standard deviations. The action
            is predicted from joints, keypoints and this predicted state; the true state is never
            used to act.
        scales: As in the mlp, but for the offsets in the environment state, predicted or, if it is
            an input, true.
        scaled: The indices of these offsets in the environment state.
        states: A dataset without pictures. If given, the mlp's network predicts the action from
            joints and predicted state alone. It is trained on the true states of this dataset and
            of the frames with pictures, plus noise of the size of the prediction's error (the
            "independent" concept bottleneck of Koh et al., ICML 2020).
        privileged_size: Size of the predicted state, taken from the dataset.
        named_points, heatmap_weight: In checkpoints that learnt heat maps: further keypoints, and
            no effect.

    Raises:
        UsageError: A size or a weight is out of range, or what `MLPConfig` raises.
    """

    channels: tuple[int, ...] = (16, 32, 32, 32)
    stride: int = option(2, "pixels between windows of the first layer", at_least=1, at_most=16)
    keypoints: int = option(32, "keypoints per camera", at_least=1, at_most=1024)
    aux_weight: float = option(0.5, "weight of the loss of the predicted state", at_least=0)
    states: str = option(
        "", "dataset of states; the policy then acts on joints and predicted state alone"
    )
    privileged_size: int = bounded(0, 0, MOST_VALUES)
    named_points: int = bounded(0, 0, 1024)
    heatmap_weight: float = 0.0

    depth: int = 2
    loss: str = "l1"
    use_amp: bool = True
    scheduler_warmup_steps: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        sizes = self.channels
        if not 2 <= len(sizes) <= _MOST_LAYERS or not 1 <= min(sizes) <= max(sizes) <= 1024:
            raise UsageError(
                f"policy.channels is {shorten(list(sizes))}; expected 2 to {_MOST_LAYERS} layers,"
                " of 1 to 1024 channels"
            )
        self.keypoints += self.named_points
        self.named_points = 0

    @override
    def validate_features(self) -> None:
        """Raise unless there are `observation.state`, `action` of the same size, and pictures."""
        super().validate_features()
        if self.states and self.reads_text:
            raise UsageError("policy.states cannot be combined with several tasks")
        if self.states and self.action_space == EE_DELTA:
            raise UsageError(
                f"policy.states cannot be combined with {EE_DELTA}; expected {JOINT_DELTA}"
            )
        if not self.image_features:
            have = ", ".join(self.input_features or {})
            raise UsageError(
                f"the cnn policy needs pictures (observation.images.*); the inputs are {have}"
            )


class CNNPolicy(MLPPolicy):
    """LeRobot's policy interface to one `KeypointEncoder` per camera and an `MLPNetwork` on joints
    and keypoints.

    Batches hold the same columns as the mlp's (`observation.environment_state` only if it is an
    input, or in training to be predicted) and `observation.images.<camera>` (B, 3, H, W), from 0 to
    1. Pictures that are larger than in training, as those of `lerobot-eval` may be, are reduced to
    that size by averaging.
    """

    config: CNNConfig
    config_class = CNNConfig  # type: ignore[assignment]
    name = "cnn"  # type: ignore[assignment]
    truth_mean: Tensor
    truth_scale: Tensor
    error: Tensor

    @override
    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return one action per row, (B, n), as `MLPPolicy` does.

        Bit-identical whatever the other rows are.
        """
        state = batch[STATE]
        # The last bits of a convolution depend on the batch size, so one row at a time. Half
        # precision is for training.
        with torch.autocast(state.device.type, enabled=False):
            keys = [*self.inputs, *self.cameras, *([TASK] if TASK in batch else [])]
            rows = [
                self.network_inputs({key: batch[key][i : i + 1] for key in keys})
                for i in range(len(state))
            ]
            return self.model.act(torch.cat(rows))

    @override
    def _build(self, config: MLPConfig) -> None:
        features = config.input_features or {}
        self.cameras = sorted(config.image_features)
        config.input_features = {key: features[key] for key in (*self.inputs, *self.cameras)}
        # with `states`: joints and true state, and action, of labelled frames
        self._states: tuple[Tensor, ...] = ()
        self.predicts = False  # whether the data have the true state to be predicted
        self._build_networks()

    def _build_networks(self) -> None:
        """Build the encoders, the perceptron that predicts the state and the one that predicts
        the action.
        """
        config = self.config
        features, size = config.input_features or {}, config.privileged_size
        n = features[STATE].shape[0]
        self.encoders = nn.ModuleList(
            [
                KeypointEncoder(config.channels, config.keypoints, config.stride)
                for _ in self.cameras
            ]
        )
        self.reader = None
        if config.reads_text:
            self.reader = TextReader([*config.channels] * len(self.cameras))
        seen = sum(features[key].shape[0] for key in self.inputs)
        self.seen_size = seen + NUMBERS * config.keypoints * len(self.cameras)
        self.privileged = None
        if size:
            self.privileged = perceptron(self.seen_size, config.width, config.depth, size, nn.SiLU)
            self.register_buffer("truth_mean", torch.zeros(size))
            self.register_buffer("truth_scale", torch.ones(size))
        self.offsets = list(config.scaled) if size or ENVIRONMENT_STATE in self.inputs else []
        if config.states:
            # mean absolute error of the predicted state in training
            self.register_buffer("error", torch.zeros(size))
            width, scaled = n + size, {"scaled": [n + i for i in self.offsets]}
        else:
            # the cnn scales the offsets itself
            width, scaled = self.seen_size + size, {"scales": ()}
            width += len(config.scales) * len(self.offsets)
        width += LENGTH if config.reads_text else 0
        self.model = MLPNetwork(width, self._numbers_out(), NetworkConfig.of(vars(config) | scaled))

    @override
    def network_inputs(self, batch: dict[str, Tensor]) -> Tensor:
        """Return the action network's inputs, (B, d): measured inputs, keypoints, predicted state,
        scaled offsets.

        With the option `states`, return only joint state and predicted state.
        """
        config = self.config
        texts = self.texts(batch)
        changes = self.reader(*texts) if self.reader else []
        layers = len(config.channels)
        keypoints = [
            encoder(self._at_size(key, batch), changes[number * layers : (number + 1) * layers])
            for number, (encoder, key) in enumerate(zip(self.encoders, self.cameras, strict=True))
        ]
        seen = torch.cat([*(batch[key] for key in self.inputs), *keypoints], dim=-1)
        parts = [seen]
        around = batch.get(ENVIRONMENT_STATE)
        with torch.autocast(seen.device.type, enabled=False):
            if self.privileged is not None:
                n = batch[STATE].shape[1]
                joints = (batch[STATE] - self.model.input_mean[:n]) * self.model.input_scale[:n]
                encoded = torch.cat([joints, seen[:, n:]], dim=-1).clamp(
                    -config.clamp, config.clamp
                )
                parts.append(self.privileged(encoded))
                around = self.truth_mean + inverse(self.truth_scale) * parts[1]
                if config.states:
                    return torch.cat([batch[STATE], around], dim=-1)
            if around is not None and self.offsets:
                parts += [torch.tanh(around[:, self.offsets] / scale) for scale in config.scales]
            return torch.cat([*parts, *texts], dim=-1)

    def _at_size(self, key: str, batch: dict[str, Tensor]) -> Tensor:
        """Return a camera's pictures (B, 3, H, W) at the size used in training, reduced by
        averaging if larger.
        """
        pictures, size = batch[key], tuple((self.config.input_features or {})[key].shape[1:])
        return pictures if pictures.shape[2:] == size else interpolate(pictures, size, mode="area")

    @override
    def _row_losses(self, inputs: Tensor, batch: dict[str, Tensor]) -> Tensor:
        with torch.autocast(inputs.device.type, enabled=False):
            if not (self.training and self.predicts):
                return super()._row_losses(inputs, batch)
            truth = batch[ENVIRONMENT_STATE]
            if self.config.states:
                errors = (inputs[:, -truth.shape[1] :] - truth).abs()
                losses = self._losses_of_states(errors.detach())
                return losses + self.config.aux_weight * (errors * self.truth_scale).mean(-1)
            wanted = (truth - self.truth_mean) * self.truth_scale
            predicted = inputs[:, self.seen_size : self.seen_size + wanted.shape[1]]
            losses = super()._row_losses(inputs, batch)
            return losses + self.config.aux_weight * (predicted - wanted).abs().mean(-1)

    def _losses_of_states(self, errors: Tensor) -> Tensor:
        """Return the action network's mean loss on `DRAWS` noisy true states for each row, (B,).

        errors: absolute errors of the predicted state in this batch, (B, k), in the state's units.
        """
        self.error.lerp_(errors.mean(0), 1.0 - _MEMORY if self.error.any() else 1.0)
        rows = torch.randint(len(self._states[0]), (DRAWS * len(errors),))
        inputs, actions = (column[rows].to(errors.device) for column in self._states)
        truth = inputs[:, -errors.shape[1] :]
        truth += (
            MOST_NOISE
            * torch.rand(len(rows), 1, device=errors.device)
            * self.error
            * torch.randn_like(truth)
        )
        return self.model.row_losses(inputs, actions).view(len(errors), DRAWS).mean(1)

    @override
    def _offsets(self, places: tuple[int, ...]) -> tuple[int, ...]:
        return places  # in the environment state, which need not be an input

    @override
    def _learn_statistics(self, table: Table, dataset_meta: Any) -> None:
        config = self.config
        truth = None
        if (
            config.aux_weight
            and ENVIRONMENT_STATE in table
            and ENVIRONMENT_STATE not in self.inputs
        ):
            truth = table[ENVIRONMENT_STATE].astype(np.float32)
        if truth is not None and not config.privileged_size:
            config.privileged_size = truth.shape[1]
            self._build_networks()
        if config.states:
            if truth is None:
                raise UsageError(
                    "policy.states needs a dataset with observation.environment_state, and"
                    " aux_weight > 0"
                )
            self._learn_states(table, dataset_meta)
        else:
            super()._learn_statistics(table, dataset_meta)
        # A checkpoint from another task has another size: it goes on without predicting.
        if truth is not None and config.privileged_size == truth.shape[1]:
            self.predicts = True
            statistics = fit_statistics(truth, truth, "mse")
            self.truth_mean.copy_(statistics["input_mean"])
            self.truth_scale.copy_(statistics["input_scale"])

    def _learn_states(self, table: Table, dataset_meta: Any) -> None:
        """Compute the action network's statistics from joints and true state, and keep all labelled
        states.

        Raises `MismatchError` if the dataset of states is not of the same robot and task as that of
        the pictures.
        """
        states = Dataset.open(Path(self.config.states).expanduser())
        pictures = getattr(dataset_meta, "datasets", None) or [Dataset.open(dataset_meta.root)]
        found, own = states.spec, pictures[0].spec
        also = () if UNKNOWN_TASK in (found.task, own.task) else ("task",)
        check_same_spec(str(states.root), found, str(pictures[0].root), own, also)
        kept = [labelled(one, [STATE, ENVIRONMENT_STATE]) for one in (table, table_of(states))]
        self._states = tuple(torch.cat(parts) for parts in zip(*kept, strict=True))
        self.model.learn_statistics(*self._states)


class KeypointEncoder(nn.Module):
    """A few convolutions and a spatial softmax.

    (Levine et al., End-to-end training of deep visuomotor policies, JMLR 2016, section 5.1.) Every
    keypoint is the softmax of one channel over the picture. It yields the mean x and y, -1 to 1,
    with subpixel resolution, and two more numbers: the deviation, which indicates the size of a
    thing and hence its distance, and the mean activation, which says whether the thing is visible
    at all, as the softmax of an empty picture has a mean, too.

    A keypoint learns only where its softmax is large, so some must start on every small thing of a
    distinct colour. Hence the picture is split into brightness and colour, and the weights start
    with variance 2 / inputs (He et al., Delving deep into rectifiers, ICCV 2015, Eq. 10). With red,
    green and blue and torch's own initialisation every softmax began nearly uniform, and a goal of
    5 pixels was not found in 1,100 steps; now 300 suffice.

    Args:
        channels: Number in each layer; the first two layers reduce the picture's sides.
        keypoints: Number of keypoints K.
        stride: Of the first layer [pixels].
    """

    def __init__(self, channels: Sequence[int], keypoints: int, stride: int = 2) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        strides = (stride, 2, *[1] * (len(channels) - 2))
        sides = zip((3, *channels[:-1]), channels, strides, strict=True)
        for i, (inputs, outputs, step) in enumerate(sides):
            kernel = 3 if i else 2 * stride + 1
            layers += [
                nn.Conv2d(inputs, outputs, kernel, stride=step, padding=kernel // 2),
                nn.ReLU(),
            ]
        self.layers = nn.Sequential(*layers)
        self.heat = nn.Conv2d(channels[-1], keypoints, 1)
        for layer in (*self.layers, self.heat):
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    def forward(self, pictures: Tensor, changes: Sequence[tuple[Tensor, Tensor]] = ()) -> Tensor:
        """Return the numbers of the keypoints, (B, 4 K) in single precision.

        Args:
            pictures: Pictures (B, 3, H, W), from 0 to 1.
            changes: Factor and shift of each layer's channels, (B, C) each; empty for none.
        """
        # Channels-last is faster on a CPU. The weights stay contiguous, as safetensors needs for an
        # optimiser's state.
        features = _light_and_colour(pictures).contiguous(memory_format=torch.channels_last)
        for number in range(len(self.layers) // 2):
            features = self.layers[2 * number](features)
            if changes:
                factor, shift = (one[..., None, None].to(features) for one in changes[number])
                features = features * factor + shift
            features = self.layers[2 * number + 1](features)
        # In half precision a keypoint would jump from pixel to pixel.
        with torch.autocast(pictures.device.type, enabled=False):
            return self._keypoints(features.float())

    def _keypoints(self, features: Tensor) -> Tensor:
        """Return the numbers of the keypoints, (B, 4 K), from features (B, C, height, width)."""
        height, width = features.shape[2:]
        # A 1 x 1 convolution as a matrix product, whose result is laid out in memory for the
        # softmax. (B, C, cells), without a copy
        cells = features.permute(0, 2, 3, 1).flatten(1, 2).transpose(1, 2)
        bias = self.heat.bias.unsqueeze(1)  # type: ignore[union-attr]
        heat = self.heat.weight.flatten(1) @ cells + bias
        weights = (_SHARPNESS * heat).softmax(-1)
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


def _light_and_colour(pictures: Tensor) -> Tensor:
    """Return the mean of red, green and blue, and red and green minus that mean, (B, 3, H, W)."""
    light = pictures.mean(1, keepdim=True)
    return torch.cat([_LIGHT * (light - 0.5), _COLOUR * (pictures[:, :2] - light)], dim=1)
