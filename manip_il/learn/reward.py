"""A reward learnt from preferences: an ensemble of networks, and the folder that holds it."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, override

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor, nn

from manip_il import checks
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError, NotFiniteError
from manip_il.learn.checkpoint import META_FILE, Origin, read_origin
from manip_il.learn.network import read_weights, threads
from manip_il.learn.trust import CONFIG, WEIGHTS, read_config

F32 = NDArray[np.float32]
PREFERENCE = "preference"  # its type, in config.json
_KINDS = {STATE: "STATE", ENVIRONMENT_STATE: "ENV", ACTION: "ACTION"}  # of its inputs, in LeRobot's words
_ROWS = 16_384  # evaluated at once


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


def ways_of(spec: RobotTaskSpec) -> tuple[tuple[int, ...], ...]:
    """Return the columns of every way in a dataset's environment state, such as `goal_from_object`, after its state.

    Each once in space and once over the table: hands approach from above.
    """
    place = {name: len(spec.joint_names) + at for at, name in enumerate(spec.environment_state_names)}
    names = [name.removesuffix(".x") for name in place if "_from_" in name and name.endswith(".x")]
    axes = [[f"{name}.{axis}" for axis in plane] for name in names for plane in ("xyz", "xy")]
    return tuple(tuple(place[one] for one in way) for way in axes if set(way) <= place.keys())


def joints_of(spec: RobotTaskSpec) -> tuple[int, ...]:
    """Return the columns of the arm's joints and of their targets, if the environment state has the hand's pose.

    None if it has not. A few hundred answers are few to find out that joints say the same in another way.
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
        self.ways, self.logarithms = [list(way) for way in shape.ways], shape.logarithms
        self.read = [column for column in range(inputs) if column not in shape.unread]
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


class LearnedReward:
    """A reward that was learnt from preferences. origin: robot, task and columns that it is for.

    About 0 at the poorest and 1 at the best of the states it was learnt on.
    """

    def __init__(self, network: RewardNetwork, origin: Origin) -> None:
        self.network, self.origin = network.eval(), origin

    @classmethod
    def load(cls, path: Path) -> LearnedReward:
        """Load a folder of `manip-il reward fit`, from JSON and safetensors alone.

        Raises `ManipError` for a folder that is not whole or is no such reward.
        """
        config = read_config(path)
        if config["type"] != PREFERENCE:
            raise ManipError(f"{path} is of type {checks.shorten(config['type'])}; expected a reward, {PREFERENCE!r}")
        origin = read_origin(path)
        if origin is None:
            raise ManipError(f"{path} does not say for which robot and task it is: {META_FILE} is missing")
        try:  # what an older one does not say is the default
            shape = RewardShape(**{one.name: config[one.name] for one in fields(RewardShape) if one.name in config})
            network = RewardNetwork(sum(_widths(origin).values()), shape)
            network.load_state_dict(read_weights(path))
        except (TypeError, IndexError, RuntimeError) as error:
            line = checks.one_line(error)
            raise ManipError(f"{path}: {CONFIG}, {META_FILE} and {WEIGHTS} do not match: {line}") from error
        return cls(network, origin)

    def check_fits(self, name: str, spec: RobotTaskSpec) -> None:
        """Raise `MismatchError` unless a dataset's columns, and its task, are those of this reward. name: of it."""
        if self.origin.task != spec.task:
            raise MismatchError("task", "the reward", self.origin.task, name, spec.task)
        self.origin.check_fits(spec)

    def __call__(self, states: F32, environment_states: F32, actions: F32) -> F32:
        """Return the reward of every row, (B,): states (B, n), environment states (B, k), absolute actions (B, n)."""
        return self.of_inputs(np.concatenate([states, environment_states, actions], axis=1, dtype=np.float32))

    @torch.inference_mode()
    def of_inputs(self, inputs: F32) -> F32:
        """Return the reward of inputs (B, n + k + n) that are one array, (B,). Raises `NotFiniteError` for others."""
        with threads(1):
            parts = [self.network(part).numpy() for part in torch.from_numpy(inputs).split(_ROWS)]
        rewards = np.concatenate(parts) if parts else np.empty(0, np.float32)
        if not np.isfinite(rewards).all():
            row = int(np.argmin(np.isfinite(rewards)))
            raise NotFiniteError(f"the reward of row {row} is {rewards[row]}: its inputs or the weights are not finite")
        return rewards

    @torch.inference_mode()
    def members(self, inputs: F32) -> NDArray[np.float64]:
        """Return every network's reward, (M, B), of inputs (B, n + k + n), in units of log-odds a step."""
        with threads(1):
            parts = [self.network.members(part).numpy() for part in torch.from_numpy(inputs).split(_ROWS)]
        return np.concatenate(parts, axis=1).astype(np.float64)


def write_reward(
    folder: Path,
    network: RewardNetwork,
    shape: RewardShape,
    spec: RobotTaskSpec,
    options: Mapping[str, Any],
    fingerprint: Mapping[str, Any],
) -> None:
    """Write a `pretrained_model` folder: config.json, model.safetensors, and for what it was trained, manip_il.json.

    options: of the fit. Raises `OSError` if it cannot be written.
    """
    origin = Origin.of(spec, fingerprint, options)
    features = {key: {"type": _KINDS[key], "shape": [width]} for key, width in _widths(origin).items()}
    outputs = {"reward": {"type": "REWARD", "shape": [1]}}
    config = {"type": PREFERENCE, "input_features": features, "output_features": outputs, **asdict(shape)}
    for name, values in ((CONFIG, config), (META_FILE, origin.to_json())):
        (folder / name).write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    save_file({f"model.{name}": tensor for name, tensor in network.state_dict().items()}, folder / WEIGHTS)


def _widths(origin: Origin) -> dict[str, int]:
    """Numbers of each input, in order."""
    n = len(origin.joint_names)
    return {STATE: n, ENVIRONMENT_STATE: len(origin.environment_state_names), ACTION: n}
