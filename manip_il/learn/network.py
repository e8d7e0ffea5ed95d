"""The `mlp` policy's network, in torch alone.

Apart from LeRobot's interface to it (`manip_il.learn.mlp`), so that a worker that only acts need
not spend seconds on importing LeRobot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from manip_il import checks
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.learn.losses import DISTRIBUTIONS, LOSSES, Distribution, make_head
from manip_il.learn.normalise import Statistics, identity_statistics, scale_targets

# The order of the sums in a matrix product changes with the number of rows. Acting always
# multiplies this many, filled up with zeros.
ROWS = 64
_ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "gelu": nn.GELU, "silu": nn.SiLU}
ACTIVATIONS = tuple(_ACTIVATIONS)
BOUNDS = {"width": (1, 16_384), "depth": (1, 100), "components": (1, 1_000), "bins": (2, 10_000)}
LARGEST_CLAMP = 1e6  # [standard deviations]


@dataclass(frozen=True)
class Shape:
    """What a network is built from; the names are those of `MLPConfig`, which says what they mean.

    Raises `ManipError` for a value out of bounds or of another type, `UnknownName` for a loss or activation.
    """

    width: int
    depth: int
    activation: str
    loss: str
    components: int
    bins: int
    clamp: float

    def __post_init__(self) -> None:
        for name, known in (("loss", LOSSES), ("activation", ACTIVATIONS)):
            value = checks.text(name, getattr(self, name), checks.LONGEST_NAME)
            if value not in known:
                raise UnknownName(name, value, known)
        for name, (least, most) in BOUNDS.items():
            checks.whole(name, getattr(self, name), least, most)
        if not checks.number("clamp", self.clamp, 0.0, LARGEST_CLAMP) > 0:
            raise ManipError(f"clamp is {self.clamp}; expected more than 0")


class MLPNetwork(nn.Module):
    """Perceptron, head and units. Inputs (B, n + k) are raw, the first n the measured joints.

    Its targets are relative to the measured joints, but for the gripper's, the last, which is
    absolute. A row's action does not depend on the rows beside it, bit for bit.
    """

    input_mean: Tensor
    input_scale: Tensor
    target_mean: Tensor
    target_scale: Tensor
    target_low: Tensor
    target_high: Tensor

    def __init__(self, inputs: int, n: int, shape: Shape) -> None:
        super().__init__()
        self.n, self.clamp, self.loss = n, shape.clamp, shape.loss
        self.head = make_head(shape.loss, n, components=shape.components, bins=shape.bins)
        self.layers = _perceptron(inputs, self.head.size, shape)
        for name, tensor in identity_statistics(inputs, n).items():
            self.register_buffer(name, tensor)

    def set_statistics(self, statistics: Statistics) -> None:
        """Take the units of the data, saved with the weights. Inputs beyond those of `statistics` have none."""
        for name, tensor in statistics.items():
            getattr(self, name)[: len(tensor)].copy_(tensor)

    def encode(self, inputs: Tensor) -> Tensor:
        """Return the perceptron's inputs from raw ones, (B, n + k)."""
        return ((inputs - self.input_mean) * self.input_scale).clamp(-self.clamp, self.clamp)

    def encode_targets(self, targets: Tensor) -> Tensor:
        """Return the head's targets from raw relative ones, (B, n)."""
        return scale_targets(targets, self.target_mean, self.target_scale)

    def row_losses(self, x: Tensor, y: Tensor) -> Tensor:
        """Return loss of each row, (B,), from encoded inputs and targets."""
        return self.head.nll(self.layers(x), y)

    @torch.no_grad()
    def act(self, inputs: Tensor) -> Tensor:
        """Return absolute actions, (B, n), each the same bits whatever the other rows are."""
        return _in_blocks(self.actions, inputs)

    def distribution(self) -> Distribution:  # no property: TorchScript would compile it
        """Return the head. Raises `UsageError` for one whose spread is not learnt."""
        if not isinstance(self.head, Distribution):
            raise UsageError(f"loss {self.loss!r} learns no spread of actions; expected {', '.join(DISTRIBUTIONS)}")
        return self.head

    @torch.no_grad()
    def sample(self, inputs: Tensor, draws: Tensor) -> Tensor:
        """Return absolute actions, (B, n), from what the distribution's `draw` gave for each row (B, m).

        Bits as in `act`.
        """

        def samples(inputs: Tensor, draws: Tensor) -> Tensor:
            drawn = self.distribution().sample(self.layers(self.encode(inputs)), draws)
            return self._absolute(inputs, drawn * self.target_scale + self.target_mean)

        return _in_blocks(samples, inputs, draws)

    @torch.no_grad()
    def log_prob(self, inputs: Tensor, actions: Tensor) -> Tensor:
        """What the distribution says of absolute actions (B, n), in normalised units, (B,); bits as in `act`."""

        def log_probs(inputs: Tensor, actions: Tensor) -> Tensor:
            targets = torch.cat([actions[:, :-1] - inputs[:, : self.n - 1], actions[:, -1:]], dim=1)
            return self.distribution().log_prob(self.layers(self.encode(inputs)), self.encode_targets(targets))

        return _in_blocks(log_probs, inputs, actions)

    def actions(self, inputs: Tensor) -> Tensor:
        """Return the same as `act` of all rows in one product, whose last bits depend on their number."""
        y = self.head.action(self.layers(self.encode(inputs)))
        # The expert's targets never left this range, so neither shall the learner's, wherever it is.
        target = torch.clamp(y * self.target_scale + self.target_mean, self.target_low, self.target_high)
        return self._absolute(inputs, target)

    def _absolute(self, inputs: Tensor, targets: Tensor) -> Tensor:
        return torch.cat([inputs[:, : self.n - 1] + targets[:, :-1], targets[:, -1:]], dim=1)


def _in_blocks(function: Callable[..., Tensor], *columns: Tensor) -> Tensor:
    """Apply a function to `ROWS` rows of the columns (B, ...) at a time, the last ones filled up with zeros."""
    rows = len(columns[0])
    padded = [column.new_zeros((max(1, -(-rows // ROWS)) * ROWS, column.shape[1])) for column in columns]
    for blocks, column in zip(padded, columns, strict=True):
        blocks[:rows] = column
    return torch.cat([function(*blocks) for blocks in zip(*(one.split(ROWS) for one in padded), strict=True)])[:rows]


def _perceptron(inputs: int, outputs: int, shape: Shape) -> nn.Sequential:
    layers: list[nn.Module] = []
    for i in range(shape.depth):
        layers += [nn.Linear(inputs if i == 0 else shape.width, shape.width), _ACTIVATIONS[shape.activation]()]
    return nn.Sequential(*layers, nn.Linear(shape.width, outputs))
