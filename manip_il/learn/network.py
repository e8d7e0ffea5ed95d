"""The `mlp` policy's network with the statistics of its data, in pure torch.

Separate from its LeRobot interface (`manip_il.learn.mlp`), so that a worker that only acts need not
spend seconds on importing LeRobot.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from manip_il.checks import native_path
from manip_il.errors import UnknownName, UsageError
from manip_il.learn.action_spaces import LAST
from manip_il.learn.checkpoint import MOST_VALUES, WEIGHTS, in_one_line
from manip_il.learn.losses import LOSSES, make_head
from manip_il.learn.names import ACTION_SPACES, JOINT_DELTA
from manip_il.learn.texts import LENGTH, TextReader
from manip_il.mdp import F32, F64
from manip_il.option import check_bounds, option

# The order of summation in a matrix product depends on the number of rows. Acting always
# multiplies this many rows, padded with zeros.
ROWS = 64
ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "gelu": nn.GELU, "silu": nn.SiLU}
# [rad] or [m]. An input that moves less than this in all of the data is noise that division by its
# deviation would amplify: it is multiplied by zero instead, so the network never sees it.
CONSTANT_INPUT = 1e-4
CONSTANT_TARGET = 1e-6


@dataclass
class NetworkConfig:
    """Sizes and kinds that a network is built from: the options of the `mlp` policy, and so of
    `MLPConfig`.

    Args:
        width: Units per layer.
        depth: Hidden layers.
        activation: One of `ACTIVATIONS`.
        loss: One of `LOSSES`.
        components: Gaussians in `mixture`.
        bins: Bins per dimension in `categorical`, over the range of the data.
        sigma: Standard deviation of a smeared target in `categorical` [bins].
        clamp: Bound on the normalised inputs, in standard deviations, so that states far from the
            data cannot blow up the outputs.
        action_space: One of `manip_il.learn.action_spaces`.
        scales: Lengths s [m]. For every offset x among the inputs (`object_from_ee.x`, ...),
            tanh(x / s) is an input, too.
        scaled: Indices of these offsets, taken from the dataset.
        grippers: Indices of the gripper openings, which are absolute in `joint_delta`, taken from
            the robot.
        reads_text: Whether the network reads the task's text; None if it does where the dataset has
            several.

    Raises:
        UnknownName: The loss, the activation or the action space is unknown.
        UsageError: A size is out of range.
    """

    width: int = option(256, "units per layer", at_least=1, at_most=4096)
    depth: int = option(3, "hidden layers", at_least=1, at_most=32)
    activation: str = "silu"
    loss: str = "l1"
    components: int = option(5, "Gaussians in a mixture", at_least=1, at_most=1000)
    bins: int = option(21, "bins per dimension", at_least=2, at_most=1000)
    sigma: float = option(3.0, "smearing of categorical targets [bins]", at_least=0)
    clamp: float = option(10.0, "bound on the inputs [standard deviations]", at_least=1e-9)
    action_space: str = JOINT_DELTA
    scales: tuple[float, ...] = ()
    scaled: tuple[int, ...] = ()
    grippers: tuple[int, ...] = LAST
    reads_text: bool | None = None

    def __post_init__(self) -> None:
        check_bounds(self, "policy.")
        known_names = {"loss": LOSSES, "activation": ACTIVATIONS, "action_space": ACTION_SPACES}
        for name, known in known_names.items():
            if getattr(self, name) not in known:
                raise UnknownName(name, str(getattr(self, name)), known)
        if not all(scale > 0 for scale in self.scales):
            raise UsageError(
                f"policy.scales is {list(self.scales)}; expected lengths of more than 0"
            )
        if (added := len(self.scales) * len(self.scaled)) > MOST_VALUES:
            raise UsageError(
                f"policy.scales adds {added:,} inputs; expected at most {MOST_VALUES:,}"
            )

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> NetworkConfig:
        """Return the options among those of a policy, as in its `config.json`."""
        return cls(**{one.name: config[one.name] for one in fields(cls) if one.name in config})


Statistics = Mapping[str, Tensor]  # named as the buffers of `MLPNetwork`


def fit_statistics(inputs: F32, targets: F32, loss: str) -> Statistics:
    """Return the statistics of a policy's inputs and targets.

    The network maps x = (input - input_mean) * input_scale to y, and target = target_mean +
    target_scale * y is clamped to [target_low, target_high], the range of the data.

    Targets are scaled by mean and deviation, or, for `categorical`, by the middle and half-width of
    their range, which puts them in [-1, 1]. A constant target has scale 0: it equals its mean.

    Args:
        inputs: Inputs (N, d) in raw units ([rad], [m]).
        targets: Targets (N, n) in raw units ([rad], [m]).
        loss: One of `LOSSES`.

    Returns:
        Vectors (d,) of the inputs and (n,) of the targets, in single precision, by the names of the
        buffers of `MLPNetwork`.
    """
    low, high = targets.min(0).astype(np.float64), targets.max(0).astype(np.float64)
    if loss == "categorical":
        target_mean, target_scale = (low + high) / 2, (high - low) / 2
    else:
        target_mean, target_scale = _mean_and_deviation(targets)
    target_scale = np.where(target_scale < CONSTANT_TARGET, 0.0, target_scale)
    input_mean, deviation = _mean_and_deviation(inputs)
    input_scale = np.where(
        deviation < CONSTANT_INPUT, 0.0, 1.0 / np.maximum(deviation, CONSTANT_INPUT)
    )
    found = {
        "input_mean": input_mean,
        "input_scale": input_scale,
        "target_mean": target_mean,
        "target_scale": target_scale,
        "target_low": low,
        "target_high": high,
    }
    return {name: torch.from_numpy(values.astype(np.float32)) for name, values in found.items()}


def _mean_and_deviation(values: F32) -> tuple[F64, F64]:
    """Return mean and standard deviation of each column."""
    mean = values.mean(0, dtype=np.float64)
    return mean, np.sqrt(np.square(values - mean).mean(0))


def inverse(scale: Tensor) -> Tensor:
    """Return 1 / scale, (n,), and 0 for a scale of 0."""
    return torch.where(scale > 0, 1.0 / scale, torch.zeros_like(scale))


def perceptron(
    inputs: int, width: int, depth: int, outputs: int, activation: type[nn.Module]
) -> nn.Sequential:
    """Return a network of `depth` hidden layers, (B, inputs) to (B, outputs).

    Args:
        inputs: Numbers in an input.
        width: Units per hidden layer.
        depth: Hidden layers, at least 1.
        outputs: Numbers in an output.
        activation: The class of the activation after each hidden layer.
    """
    layers: list[nn.Module] = []
    for size in (inputs, *[width] * (depth - 1)):
        layers += [nn.Linear(size, width), activation()]
    return nn.Sequential(*layers, nn.Linear(width, outputs))


class MLPNetwork(nn.Module):
    """Perceptron, head and normalisation.

    Inputs (B, n + k) are raw; the first n are the measured joints. If the network reads texts, the
    last columns are those of `manip_il.learn.texts.tokens`, (B, n + k + `LENGTH`).

    In the space `joint_delta` the targets of arm joints are relative to the measured joints, which
    the network adds itself; the targets of grippers are absolute. In all other spaces it returns
    the targets, which `action_spaces` converts to actions. A row's action does not depend on the
    other rows, bit for bit.

    Args:
        inputs: Numbers in an input, n + k.
        n: Numbers in an action.
        config: The sizes and kinds of the network.
    """

    added: Tensor  # 1 for the measured joints that are added to the targets, else 0, (n,)
    input_mean: Tensor
    input_scale: Tensor
    target_mean: Tensor
    target_scale: Tensor
    target_low: Tensor
    target_high: Tensor

    def __init__(self, inputs: int, n: int, config: NetworkConfig) -> None:
        super().__init__()
        self.n = n
        self.clamp = config.clamp
        self.loss = config.loss
        self.adds = config.action_space == JOINT_DELTA
        added = torch.full((n,), float(config.action_space == JOINT_DELTA))
        added[list(config.grippers)] = 0.0
        self.register_buffer("added", added, persistent=False)
        self.scales = config.scales
        self.scaled = list(config.scaled)
        self.inputs = inputs
        self.reader = TextReader([config.width] * config.depth) if config.reads_text else None
        inputs -= LENGTH if config.reads_text else 0
        self.numbers = inputs
        inputs += len(self.scales) * len(self.scaled)
        self.head = make_head(
            config.loss, n, components=config.components, bins=config.bins, sigma=config.sigma
        )
        activation = ACTIVATIONS[config.activation]
        self.layers = perceptron(inputs, config.width, config.depth, self.head.size, activation)
        for name, size in (("input", inputs), ("target", n)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))
        self.register_buffer("target_low", torch.full((n,), -torch.inf))
        self.register_buffer("target_high", torch.full((n,), torch.inf))

    def set_statistics(self, statistics: Statistics) -> None:
        """Set the statistics of the data.

        Inputs beyond the length of `statistics` keep mean 0 and scale 1.
        """
        for name, tensor in statistics.items():
            getattr(self, name)[: len(tensor)].copy_(tensor)

    def learn_statistics(self, inputs: Tensor, actions: Tensor) -> None:
        """Set the statistics to those of raw inputs (N, n + k) and absolute actions (N, n)."""
        targets = self.relative(actions, inputs).numpy()
        self.set_statistics(fit_statistics(self.expanded(inputs).numpy(), targets, self.loss))

    def expanded(self, inputs: Tensor) -> Tensor:
        """Return the numbers among the inputs, (B, n + k), with tanh(offset / scale) appended for
        each scale, so that millimetres matter.
        """
        inputs = inputs[:, : self.numbers]
        if not self.scales:
            return inputs
        return torch.cat(
            [inputs, *(torch.tanh(inputs[:, self.scaled] / scale) for scale in self.scales)], dim=1
        )

    def encode(self, inputs: Tensor) -> Tensor:
        """Return the perceptron's normalised inputs for raw inputs (B, n + k)."""
        return ((self.expanded(inputs) - self.input_mean) * self.input_scale).clamp(
            -self.clamp, self.clamp
        )

    def encode_targets(self, targets: Tensor) -> Tensor:
        """Return normalised targets (B, n) for raw targets (B, n), as from `relative`.

        0 for a target with scale 0.
        """
        return (targets - self.target_mean) * inverse(self.target_scale)

    def row_losses(self, inputs: Tensor, actions: Tensor) -> Tensor:
        """Return the loss of each row, (B,), for raw inputs (B, n + k) and absolute actions (B,
        n).
        """
        targets = self.encode_targets(self.relative(actions, inputs))
        return self.head.nll(self.outputs(inputs), targets)

    def outputs(self, inputs: Tensor) -> Tensor:
        """Return the perceptron's outputs, (B, h), for raw inputs (B, n + k), which its head turns
        into targets.
        """
        if self.reader is None:
            return self.layers(self.encode(inputs))
        if inputs.shape[1] != self.inputs:
            raise UsageError("the policy reads the task's text, which is not given here")
        hidden = self.encode(inputs)
        changes = self.reader(inputs[:, self.numbers :])
        for number, (factor, shift) in enumerate(changes):
            linear, activation = self.layers[2 * number], self.layers[2 * number + 1]
            hidden = activation(linear(hidden) * factor + shift)
        return self.layers[-1](hidden)

    def relative(self, actions: Tensor, inputs: Tensor) -> Tensor:
        """Return absolute actions (B, n) minus the measured joints that the network adds to its
        output.
        """
        return actions - self._measured(inputs)

    @torch.no_grad()
    def act(self, inputs: Tensor) -> Tensor:
        """Return actions, (B, n), each bit-identical whatever the other rows are."""
        rows = len(inputs)  # will be padded with zeros to a multiple of `ROWS`
        padded = inputs.new_zeros((max(1, -(-rows // ROWS)) * ROWS, inputs.shape[1]))
        padded[:rows] = inputs
        return torch.cat([self.actions(block) for block in padded.split(ROWS)])[:rows]

    def actions(self, inputs: Tensor) -> Tensor:
        """Return actions, (B, n), for all rows at once.

        The last bits depend on the number of rows.
        """
        return self.decode_targets(self.head.action(self.outputs(inputs))) + self._measured(inputs)

    def decode_targets(self, y: Tensor) -> Tensor:
        """Return raw targets (B, n) for normalised targets (B, n), as from `encode_targets`.

        The expert's targets never left their range in the data, so these do not either.
        """
        return torch.clamp(
            y * self.target_scale + self.target_mean, self.target_low, self.target_high
        )

    def _measured(self, inputs: Tensor) -> Tensor | float:
        """Return the measured joints that are added to the targets, (B, n); 0 if there are none."""
        return self.added * inputs[:, : self.n] if self.adds else 0.0


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch use `count` threads in a `with` block.

    Idle ones busy-wait: two on one core are far slower than one.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def require_device(device: str) -> None:
    """Raise `UsageError` for a GPU if PyTorch finds none."""
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UsageError(f"device is {device!r}, but PyTorch finds no GPU here; expected 'cpu'")


def read_weights(pretrained_model: Path) -> dict[str, Tensor]:
    """Return weights (n, d) and statistics (n,) by name from a folder.

    Raises:
        ManipError: They cannot be read.
    """
    path = Path(pretrained_model) / WEIGHTS
    with in_one_line(f"{path} cannot be read"), native_path(path, "weights") as opened:
        return {name.removeprefix("model."): tensor for name, tensor in load_file(opened).items()}


@torch.no_grad()
def warm_start(network: MLPNetwork, pretrained_model: Path) -> None:
    """Copy the weights from a `pretrained_model` folder.

    `network` then acts like that policy, up to rounding.

    The input statistics stay those of the new data: the first layer compensates for the difference.
    (An input normaliser frozen at the first round of DAgger puts later rounds' states out of
    scale.) The range of the targets is also that of the new data; their mean and scale are copied,
    as they are only the unit of the outputs.

    Args:
        network: The network, which has the statistics of the new data.
        pretrained_model: The folder of the policy to start from.

    Raises:
        ManipError: The weights cannot be read or do not fit.
    """
    of_new_data = ("input_mean", "input_scale", "target_low", "target_high")
    kept = {name: getattr(network, name).clone() for name in of_new_data}
    with in_one_line(f"the weights in {pretrained_model} do not fit the new network"):
        network.load_state_dict(read_weights(pretrained_model))
    # x_old = (u - mean_old) scale_old and x = (u - mean) scale, so x_old = x scale_old / scale +
    # offset
    first = network.layers[0]
    assert isinstance(first, torch.nn.Linear)
    scale = kept["input_scale"]
    offset = (kept["input_mean"] - network.input_mean) * network.input_scale
    first.bias.add_(first.weight @ offset)
    first.weight.mul_(torch.where(scale > 0, network.input_scale / scale, torch.zeros_like(scale)))
    network.set_statistics(kept)
