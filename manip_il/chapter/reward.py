"""A learnt reward, from preferences or by AIRL: its networks, and the folder that holds it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, override

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from manip_il import checks
from manip_il.data.atomic import write_json
from manip_il.errors import ManipError, MismatchError
from manip_il.learn.checkpoint import (
    CONFIG,
    META_FILE,
    WEIGHTS,
    Origin,
    in_one_line,
    read_config,
    read_origin,
)
from manip_il.learn.network import read_weights, threads
from manip_il.mdp import F32
from manip_il.worlds.contract import EnvironmentSpec

PREFERENCE = "preference"  # type of a learnt reward in config.json, AIRL's included
_RANGE = (0.01, 0.99)  # quantiles of the frames' rewards that become 0 and 1
_MOST_FRAMES = 100_000  # of which about as many are enough for the quantiles
_ROWS = 16_384  # rows that are evaluated at a time


@dataclass(frozen=True)
class RewardShape:
    """Sizes of the networks.

    Attributes:
        members: Networks in the ensemble.
        width: Units per layer.
        depth: Hidden layers.
        ways: For each offset between two things [m], its input columns: x, y and z, or x and y. The
            logarithm of the offset's length is an input, too, so that the last centimetres count as
            much as the first decimetres. Progress mostly depends on distances, and a few hundred
            answers are too few to learn a square root from.
        unread: Input columns that the networks do not use.
    """

    members: int = 8
    width: int = 32
    depth: int = 2
    ways: tuple[tuple[int, ...], ...] = ()
    unread: tuple[int, ...] = ()


def ways_of(spec: EnvironmentSpec) -> tuple[tuple[int, ...], ...]:
    """Return the input columns of every offset in the environment state, such as
    `goal_from_object`.

    Each offset appears twice, in 3D and in the plane of the table, because the hand approaches from
    above.
    """
    place = {
        name: len(spec.joint_names) + at for at, name in enumerate(spec.environment_state_names)
    }
    names = [name.removesuffix(".x") for name in place if "_from_" in name and name.endswith(".x")]
    axes = [[f"{name}.{axis}" for axis in plane] for name in names for plane in ("xyz", "xy")]
    return tuple(tuple(place[one] for one in way) for way in axes if set(way) <= place.keys())


def joints_of(spec: EnvironmentSpec) -> tuple[int, ...]:
    """Return the input columns of the arm's joints and their targets if the environment state has
    the hand's pose.

    Otherwise return (). A few hundred answers are too few to learn that joints are redundant with
    the pose.
    """
    if not {"ee.x", "ee.y", "ee.z"} <= set(spec.environment_state_names):
        return ()
    joints, seen = len(spec.joint_names), len(spec.environment_state_names)
    return tuple(at + joint for at in (0, joints + seen) for joint in range(joints - 1))


def shape_for(spec: EnvironmentSpec, members: int) -> RewardShape:
    """Return the shape of the networks to fit to answers about a task's clips."""
    return RewardShape(members, ways=ways_of(spec), unread=joints_of(spec))


class RewardNetwork(nn.Module):
    """M perceptrons from (state, environment state, action) to a reward.

    Inputs are standardised and clamped to `CLAMP` standard deviations, so that states far from the
    data have the reward at the bound.

    Attributes:
        mean: Mean of each input of the perceptrons.
        std: Standard deviation of each input of the perceptrons.
        low: Mean reward of the M perceptrons that `forward` maps to 0.
        high: Mean reward of the M perceptrons that `forward` maps to 1.
    """

    CLAMP = 5.0
    NEAR = 0.01  # added to a length before taking its logarithm [m]
    mean: Tensor
    std: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, inputs: int, shape: RewardShape) -> None:
        """Make networks whose weights are all zero; `initialise` draws them.

        Args:
            inputs: Number of input columns.
            shape: Sizes of the networks.
        """
        super().__init__()
        self.shape = shape
        self.ways = [list(way) for way in shape.ways]
        self.read = [column for column in range(inputs) if column not in shape.unread]
        inputs = len(self.read) + len(shape.ways)
        layers = list(itertools.pairwise([inputs, *[shape.width] * shape.depth, 1]))
        self.weights = nn.ParameterList(
            torch.zeros(shape.members, fan_in, out) for fan_in, out in layers
        )
        self.biases = nn.ParameterList(torch.zeros(shape.members, 1, out) for _, out in layers)
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("std", torch.ones(inputs))
        self.register_buffer("low", torch.zeros(()))
        self.register_buffer("high", torch.ones(()))

    def initialise(self, generator: torch.Generator) -> None:
        """Draw normal weights of variance 2 / fan-in (He et al. 2015), a hundredth as wide in
        the last layer.
        """
        with torch.no_grad():
            for number, weight in enumerate(self.weights):
                last = number == len(self.weights) - 1
                spread = math.sqrt(2 / weight.shape[1]) * (0.01 if last else 1.0)
                weight.copy_(spread * torch.randn(weight.shape, generator=generator))

    def set_range(self, rewards: Tensor) -> None:
        """Let `forward` map a low and a high quantile of mean rewards (N,) to 0 and 1."""
        some = rewards[:: max(1, len(rewards) // _MOST_FRAMES)]
        low, high = torch.quantile(some, torch.tensor(_RANGE)).tolist()
        self.low.fill_(low)
        self.high.fill_(max(high, low + 1e-6))

    def features(self, inputs: Tensor) -> Tensor:
        """Return the used columns of the inputs (B, d), then the log-lengths of the K offsets,
        (B, up to d + K).
        """
        lengths = [
            (inputs[:, way].norm(dim=-1, keepdim=True) + self.NEAR).log() for way in self.ways
        ]
        return torch.cat([inputs[:, self.read], *lengths], dim=-1)

    def members(self, inputs: Tensor) -> Tensor:
        """Return each network's reward, (M, B), for inputs (B, d), in log-odds per step."""
        x = ((self.features(inputs) - self.mean) / self.std).clamp(-self.CLAMP, self.CLAMP)
        hidden = x.expand(len(self.weights[0]), *x.shape)
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.baddbmm(bias, hidden, weight)
            if number < len(self.weights) - 1:
                hidden = nn.functional.silu(hidden)
        return hidden.squeeze(-1)

    def logits(self, inputs: Tensor, sides: Tensor) -> Tensor:
        """Return R(left) - R(right) of A pairs of clips for every network, (M, A).

        Args:
            inputs: Inputs of all frames, (N, d).
            sides: Rows of `inputs` of the left and right clips, (A, 2, L).
        """
        rows = [sides[:, side] for side in (0, 1)]
        left, right = (
            self.members(inputs[one.reshape(-1)]).view(-1, *one.shape).sum(-1) for one in rows
        )
        return left - right

    @override
    def forward(self, inputs: Tensor) -> Tensor:
        """Return the mean of the M rewards, (B,), for inputs (B, d), scaled to be 0 at `low` and
        1 at `high`.
        """
        return (self.members(inputs).mean(0) - self.low) / (self.high - self.low)


class LearnedReward:
    """A reward learnt from preferences or by AIRL.

    It is about 0 for the worst and 1 for the best of the states that it was trained on.

    Attributes:
        network: The networks.
        origin: Robot, task and columns that the reward is for.
    """

    def __init__(self, network: RewardNetwork, origin: Origin) -> None:
        self.network, self.origin = network.eval(), origin

    @classmethod
    def load(cls, path: Path) -> LearnedReward:
        """Load a folder that `write_reward` wrote, only from JSON and safetensors.

        Raises `ManipError` for a folder that is incomplete or holds something else.
        """
        config, origin = read_config(path), read_origin(path)
        if config["type"] != PREFERENCE or origin is None:
            kind = checks.shorten(config["type"])
            raise ManipError(f"{path} is of type {kind}; expected {PREFERENCE!r}, with {META_FILE}")
        with in_one_line(f"{path}: {CONFIG}, {META_FILE} and {WEIGHTS} do not match"):
            shape = RewardShape(**{one.name: config[one.name] for one in fields(RewardShape)})
            width = 2 * len(origin.joint_names) + len(origin.environment_state_names)
            network = RewardNetwork(width, shape)
            network.load_state_dict(read_weights(path))
        return cls(network, origin)

    def check_fits(self, name: str, spec: EnvironmentSpec) -> None:
        """Raise `MismatchError` unless `spec` has this reward's task and columns.

        Args:
            name: What messages call `spec`.
            spec: The environment.
        """
        if self.origin.task != spec.task:
            raise MismatchError("task", "the reward", self.origin.task, name, spec.task)
        self.origin.check_fits(spec)

    def __call__(self, inputs: F32) -> F32:
        """Return every row's reward, (B,), for rows of state, environment state and absolute
        action, (B, n + k + n).
        """
        with threads(1), torch.inference_mode():
            parts = torch.from_numpy(inputs).split(_ROWS)
            return np.concatenate([self.network(part).numpy() for part in parts])


def write_reward(
    folder: Path,
    network: RewardNetwork,
    spec: EnvironmentSpec,
    options: Mapping[str, Any],
    fingerprint: Mapping[str, Any],
) -> None:
    """Write a reward to a `pretrained_model` folder.

    The files are config.json, model.safetensors, and manip_il.json with the reward's origin.

    Args:
        folder: An existing folder; files of these names in it are replaced.
        network: The fitted networks.
        spec: The environment whose states and actions the reward takes.
        options: Options of the fit.
        fingerprint: Fingerprint of the datasets' environment.

    Raises:
        OSError: If a file cannot be written.
    """
    origin = Origin.of(spec, fingerprint, options)
    write_json(folder / CONFIG, {"type": PREFERENCE, **asdict(network.shape)})
    origin.write(folder)
    save_file(
        {f"model.{name}": tensor for name, tensor in network.state_dict().items()}, folder / WEIGHTS
    )
