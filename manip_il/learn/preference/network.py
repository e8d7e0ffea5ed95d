"""An ensemble of reward networks of equal shape, evaluated together."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import override

import torch
from torch import Tensor, nn

from manip_il import checks
from manip_il.data.schema import RobotTaskSpec
from manip_il.errors import ManipError

LEAST_MEMBERS = 3  # each leaves one fold of the pairs out


@dataclass(frozen=True)
class RewardShape:
    """Sizes of the networks. members: of the ensemble; width: units a layer; depth: hidden layers.

    ways: columns of inputs that are the way from one thing to another [m], x, y and z or x and y alone; its length is
    an input, too, or with `logarithms` the logarithm of that: the last centimetres count as much as the first
    decimetres. How far things are apart is most of what progress is, and a few hundred answers are few to learn a
    square root from. unread: columns that are no inputs of the networks.
    """

    members: int = 8
    width: int = 32
    depth: int = 2
    ways: tuple[tuple[int, ...], ...] = ()
    unread: tuple[int, ...] = ()
    logarithms: bool = False

    def __post_init__(self) -> None:
        checks.whole("members", self.members, LEAST_MEMBERS, 1_000)
        checks.whole("width", self.width, 1, 100_000)
        checks.whole("depth", self.depth, 1, 1_000)
        for way in self.ways:
            if not 2 <= len(checks.array("a way", way)) <= 3:
                raise ManipError(f"a way is {checks.shorten(way)}; expected columns of x, y and z, or of x and y")
        for column in (*itertools.chain(*self.ways), *self.unread):
            checks.whole("a column", column, 0, 1_000_000)


def ways_of(spec: RobotTaskSpec) -> tuple[tuple[int, ...], ...]:
    """Return the columns of every way in a dataset's environment state, such as `goal_from_object`, after its state.

    Each once in space and once over the table: hands approach from above.
    """
    place = {name: len(spec.joint_names) + at for at, name in enumerate(spec.environment_state_names)}
    names = [name.removesuffix(".x") for name in place if "_from_" in name and name.endswith(".x")]
    axes = [[f"{name}.{axis}" for axis in plane] for name in names for plane in ("xyz", "xy")]
    return tuple(tuple(place[one] for one in way) for way in axes if set(way) <= place.keys())


def joints_of(spec: RobotTaskSpec) -> tuple[int, ...]:
    """Return the columns of the arm's joints and of their targets, where the environment state has the hand's pose.

    None where it has not. A few hundred answers are few to find out that joints say the same in another way.
    """
    if not {"ee.x", "ee.y", "ee.z"} <= set(spec.environment_state_names):
        return ()
    arm, action = len(spec.joint_names) - 1, len(spec.joint_names) + len(spec.environment_state_names)
    return (*range(arm), *range(action, action + arm))


def shape_for(spec: RobotTaskSpec, members: int) -> RewardShape:
    """Return the networks that are fitted to answers about a task's clips."""
    return RewardShape(members, ways=ways_of(spec), unread=joints_of(spec), logarithms=True)


class RewardNetwork(nn.Module):
    """M perceptrons from (state, environment state, action) to a reward.

    Inputs are standardised and clamped to `CLAMP` standard deviations, so that a state far off the data has the reward
    of the border. `low`, `high`: rewards of the mean network that `forward` puts at 0 and 1.
    """

    CLAMP = 5.0
    NEAR = 0.01  # added to a length before its logarithm is taken [m]
    mean: Tensor
    std: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, inputs: int, shape: RewardShape) -> None:
        super().__init__()
        if any(column >= inputs for way in shape.ways for column in way):
            raise ManipError(f"a way has column {max(map(max, shape.ways))}; there are {inputs} inputs")
        unread = set(shape.unread)
        if not unread < set(range(inputs)):
            raise ManipError(f"{len(unread)} columns up to {max(unread, default=0)} are not read of {inputs} inputs")
        self.ways, self.logarithms = [list(way) for way in shape.ways], shape.logarithms
        self.read = [column for column in range(inputs) if column not in unread]
        inputs = len(self.read) + len(shape.ways)
        sizes = [inputs, *[shape.width] * shape.depth, 1]
        layers = list(itertools.pairwise(sizes))
        self.weights = nn.ParameterList(torch.zeros(shape.members, fan_in, out) for fan_in, out in layers)
        self.biases = nn.ParameterList(torch.zeros(shape.members, 1, out) for _, out in layers)
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("std", torch.ones(inputs))
        self.register_buffer("low", torch.zeros(()))
        self.register_buffer("high", torch.ones(()))

    def initialise(self, generator: torch.Generator) -> None:
        """Draw the weights: normal, of variance 2 / fan-in (He et al. 2015), the last layer's a hundredth as wide."""
        with torch.no_grad():
            for number, weight in enumerate(self.weights):
                last = number == len(self.weights) - 1
                spread = math.sqrt(2 / weight.shape[1]) * (0.01 if last else 1.0)
                weight.copy_(spread * torch.randn(weight.shape, generator=generator))

    def features(self, inputs: Tensor) -> Tensor:
        """Return the columns of inputs (B, d) that are read, with the lengths of their ways, (B, up to d + K)."""
        lengths = [inputs[:, way].norm(dim=-1, keepdim=True) for way in self.ways]
        if self.logarithms:
            lengths = [(one + self.NEAR).log() for one in lengths]
        return torch.cat([inputs[:, self.read], *lengths], dim=-1)

    def members(self, inputs: Tensor) -> Tensor:
        """Return each network's reward, (M, B), of inputs (B, d), in the units in which preferences are log-odds."""
        x = ((self.features(inputs) - self.mean) / self.std).clamp(-self.CLAMP, self.CLAMP)
        hidden = x.expand(len(self.weights[0]), *x.shape)
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.baddbmm(bias, hidden, weight)
            if number < len(self.weights) - 1:
                hidden = nn.functional.silu(hidden)
        return hidden.squeeze(-1)

    @override
    def forward(self, inputs: Tensor) -> Tensor:
        """Return the mean network's reward, (B,), of inputs (B, d): 0 at `low`, 1 at `high`."""
        return (self.members(inputs).mean(0) - self.low) / (self.high - self.low)
