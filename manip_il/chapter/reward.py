"""A reward learnt from preferences: an ensemble of networks, its fit, and the folder that holds it.

It is fitted with the Bradley-Terry model of preferences between clips, in folds: every pair is held out from one of
the networks.

    P(left is better) = (1 - E) sigmoid(R(left) - R(right)) + E / 2,    R(clip) = sum over its steps of r(s, a)

(Bradley & Terry 1952; Christiano et al. 2017, section 2.2.3, where E = 0.1 is the share of answers that are random,
whatever the clips.)
"""

from __future__ import annotations

import copy
import itertools
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, override

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from manip_il import checks
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError
from manip_il.learn.batches import generator_of
from manip_il.learn.checkpoint import CONFIG, META_FILE, WEIGHTS, Origin, in_one_line, read_config, read_origin
from manip_il.learn.network import read_weights, threads
from manip_il.mdp import F32, F64, I64
from manip_il.option import bounded, check_bounds

PREFERENCE = "preference"  # type of a learnt reward in config.json
_KINDS = {STATE: "STATE", ENVIRONMENT_STATE: "ENV", ACTION: "ACTION"}  # LeRobot's types of the inputs
_ROWS = 16_384  # rows evaluated at a time
BY_CHANCE = 0.1  # E, the share of random answers
_LR = 1e-4
_WEIGHT_DECAY = 1.0
_BATCH = 16
_EPOCHS, _PATIENCE = 200, 15
_RANGE = (0.01, 0.99)  # quantiles of the frames' rewards that become 0 and 1


@dataclass(frozen=True)
class RewardShape:
    """Sizes of the networks. members: networks in the ensemble; width: units per layer; depth: hidden layers.

    ways: for each offset between two things [m], its input columns: x, y and z, or x and y. The offset's length is an
    input, too; if `logarithms`, its logarithm, so that the last centimetres count as much as the first decimetres.
    Progress mostly depends on distances, and a few hundred answers are too few to learn a square root from. unread:
    input columns that the networks do not use.
    """

    members: int = bounded(8, 1, 64)
    width: int = bounded(32, 1, 4096)
    depth: int = bounded(2, 1, 32)
    ways: tuple[tuple[int, ...], ...] = ()
    unread: tuple[int, ...] = ()
    logarithms: bool = False

    def __post_init__(self) -> None:
        check_bounds(self)


def ways_of(spec: RobotTaskSpec) -> tuple[tuple[int, ...], ...]:
    """Return the input columns of every offset in the environment state, such as `goal_from_object`.

    Each offset appears twice, in 3D and in the plane of the table, because the hand approaches from above.
    """
    place = {name: len(spec.joint_names) + at for at, name in enumerate(spec.environment_state_names)}
    names = [name.removesuffix(".x") for name in place if "_from_" in name and name.endswith(".x")]
    axes = [[f"{name}.{axis}" for axis in plane] for name in names for plane in ("xyz", "xy")]
    return tuple(tuple(place[one] for one in way) for way in axes if set(way) <= place.keys())


def joints_of(spec: RobotTaskSpec) -> tuple[int, ...]:
    """Return the input columns of the arm's joints and their targets if the environment state has the hand's pose.

    Otherwise return (). A few hundred answers are too few to learn that joints are redundant with the pose.
    """
    if not {"ee.x", "ee.y", "ee.z"} <= set(spec.environment_state_names):
        return ()
    arm, action = len(spec.joint_names) - 1, len(spec.joint_names) + len(spec.environment_state_names)
    return (*range(arm), *range(action, action + arm))


def shape_for(spec: RobotTaskSpec, members: int) -> RewardShape:
    """Return the shape of the networks to fit to answers about a task's clips."""
    return RewardShape(members, ways=ways_of(spec), unread=joints_of(spec), logarithms=True)


class RewardNetwork(nn.Module):
    """M perceptrons from (state, environment state, action) to a reward.

    Inputs are standardised and clamped to `CLAMP` standard deviations, so that states far from the data have the reward
    at the bound. `low`, `high`: mean rewards of the M perceptrons that `forward` maps to 0 and 1.
    """

    CLAMP = 5.0
    NEAR = 0.01  # added to a length before taking its logarithm [m]
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
        """Draw normal weights of variance 2 / fan-in (He et al. 2015), a hundredth as wide in the last layer."""
        with torch.no_grad():
            for number, weight in enumerate(self.weights):
                last = number == len(self.weights) - 1
                spread = math.sqrt(2 / weight.shape[1]) * (0.01 if last else 1.0)
                weight.copy_(spread * torch.randn(weight.shape, generator=generator))

    def features(self, inputs: Tensor) -> Tensor:
        """Return the used columns of the inputs (B, d), then the lengths of the K offsets, (B, up to d + K)."""
        lengths = [inputs[:, way].norm(dim=-1, keepdim=True) for way in self.ways]
        if self.logarithms:
            lengths = [(one + self.NEAR).log() for one in lengths]
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

    @override
    def forward(self, inputs: Tensor) -> Tensor:
        """Return the mean of the M rewards, (B,), for inputs (B, d), scaled to be 0 at `low` and 1 at `high`."""
        return (self.members(inputs).mean(0) - self.low) / (self.high - self.low)


class LearnedReward:
    """A reward learnt from preferences. origin: robot, task and columns that it is for.

    It is about 0 for the worst and 1 for the best of the states that it was trained on.
    """

    def __init__(self, network: RewardNetwork, origin: Origin) -> None:
        self.network, self.origin = network.eval(), origin

    @classmethod
    def load(cls, path: Path) -> LearnedReward:
        """Load a folder written by `manip-il reward fit`, only from JSON and safetensors.

        Raises `ManipError` for a folder that is incomplete or holds something else.
        """
        config, origin = read_config(path), read_origin(path)
        if config["type"] != PREFERENCE or origin is None:
            kind = checks.shorten(config["type"])
            raise ManipError(f"{path} is of type {kind}; expected {PREFERENCE!r}, with {META_FILE}")
        with in_one_line(f"{path}: {CONFIG}, {META_FILE} and {WEIGHTS} do not match"):
            # fields missing in older files have their defaults
            shape = RewardShape(**{one.name: config[one.name] for one in fields(RewardShape) if one.name in config})
            network = RewardNetwork(sum(_widths(origin).values()), shape)
            network.load_state_dict(read_weights(path))
        return cls(network, origin)

    def check_fits(self, name: str, spec: RobotTaskSpec) -> None:
        """Raise `MismatchError` unless `spec` has this reward's task and columns. name: what messages call `spec`."""
        if self.origin.task != spec.task:
            raise MismatchError("task", "the reward", self.origin.task, name, spec.task)
        self.origin.check_fits(spec)

    def __call__(self, states: F32, environment_states: F32, actions: F32) -> F32:
        """Return every row's reward, (B,), for states (B, n), environment states (B, k), absolute actions (B, n)."""
        return self.of_inputs(np.concatenate([states, environment_states, actions], axis=1, dtype=np.float32))

    @torch.inference_mode()
    def of_inputs(self, inputs: F32) -> F32:
        """Return the reward, (B,), of concatenated inputs (B, n + k + n)."""
        with threads(1):
            parts = [self.network(part).numpy() for part in torch.from_numpy(inputs).split(_ROWS)]
        return np.concatenate(parts)

    @torch.inference_mode()
    def members(self, inputs: F32) -> F64:
        """Return every network's reward in log-odds per step, (M, B). inputs: as in `__call__`."""
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
    """Write a `pretrained_model` folder: config.json, model.safetensors, and its origin, manip_il.json.

    options: the options of the fit. Raises `OSError` if it cannot be written.
    """
    origin = Origin.of(spec, fingerprint, options)
    features = {key: {"type": _KINDS[key], "shape": [width]} for key, width in _widths(origin).items()}
    outputs = {"reward": {"type": "REWARD", "shape": [1]}}
    config = {"type": PREFERENCE, "input_features": features, "output_features": outputs, **asdict(shape)}
    for name, values in ((CONFIG, config), (META_FILE, origin.to_json())):
        (folder / name).write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    save_file({f"model.{name}": tensor for name, tensor in network.state_dict().items()}, folder / WEIGHTS)


def _widths(origin: Origin) -> dict[str, int]:
    """Return the size of each input, in order."""
    n = len(origin.joint_names)
    return {STATE: n, ENVIRONMENT_STATE: len(origin.environment_state_names), ACTION: n}


@dataclass(frozen=True, eq=False)
class Compared:
    """Answers on pairs of clips. left, right: input rows of each clip, (A, L).

    better: preference for left, (A,), 0 to 1. pair: index of the pair that was asked about, (A,); answers about one
    pair are held out together.
    """

    left: I64
    right: I64
    better: F64
    pair: I64


@dataclass(frozen=True, eq=False)
class Fit:
    """The networks, and the held-out prediction for every answer.

    logits: R(left) - R(right) of every answer, (A,), by the network that held it out. epochs: number of
    epochs that the networks were trained for.
    """

    network: RewardNetwork
    logits: F64
    epochs: int


def fit_reward(
    inputs: F32, compared: Compared, shape: RewardShape, seed: int, on_epoch: Callable[[], None] = lambda: None
) -> Fit:
    """Fit the networks to answers. inputs: the networks' inputs for every frame, (N, d).

    The pairs are split into as many folds as there are networks: network m holds out fold m and trains on the others.
    All stop at the epoch with the lowest loss on the held-out folds. The same arguments give the same bits. Raises
    `ManipError` for fewer pairs than networks.
    """
    folds = deal(compared.pair, shape.members, seed)
    with threads(1):
        network = RewardNetwork(inputs.shape[1], shape)
        network.initialise(generator_of(seed, 0))
        every = torch.from_numpy(inputs)
        features = network.features(every)
        network.mean.copy_(features.mean(0))
        network.std.copy_(features.std(0).clamp(min=1e-6))
        epochs = _train(network, every, compared, folds, seed, on_epoch)
        with torch.no_grad():
            logits = _logits(network, every, compared, slice(None))
            rewards = torch.cat([network.members(part).mean(0) for part in every.split(8_192)])
            low, high = torch.quantile(rewards[:: max(1, len(rewards) // 100_000)], torch.tensor(_RANGE)).tolist()
        network.low.fill_(low)
        network.high.fill_(max(high, low + 1e-6))
    own = logits.numpy()[folds, np.arange(len(folds))]
    return Fit(network, own.astype(np.float64), epochs)


def deal(pair: I64, folds: int, seed: int) -> I64:
    """Return the fold of every answer, (A,); all answers about a pair are in the same fold."""
    names, place = np.unique(pair, return_inverse=True)
    if len(names) < folds:
        raise ManipError(f"only {len(names)} pairs have an answer (left, right or equal); expected at least {folds}")
    order = np.random.default_rng([seed, 2]).permutation(len(names))
    return (order % folds)[place]


def _train(
    network: RewardNetwork, inputs: Tensor, compared: Compared, folds: I64, seed: int, on_epoch: Callable[[], None]
) -> int:
    """Train all networks at once; restore the weights of the epoch with the lowest held-out loss and return its number.

    Each network is evaluated on the fold that it holds out, so the mean loss covers every answer once. All stop at
    the same epoch: a choice by a single fold of some 25 answers would be mostly noise.
    """
    member = np.arange(len(network.weights[0]))[:, None]
    left_out = torch.from_numpy(folds == member)
    learns = (~left_out).float()
    better = torch.from_numpy(compared.better).float()
    optimizer = torch.optim.AdamW(network.parameters(), lr=_LR, weight_decay=_WEIGHT_DECAY)
    lowest, best = math.inf, 0
    kept = copy.deepcopy(network.state_dict())
    generator = generator_of(seed, 1)
    for epoch in range(1, _EPOCHS + 1):
        for rows in torch.randperm(len(better), generator=generator).split(_BATCH):
            losses = answer_losses(_logits(network, inputs, compared, rows.numpy()), better[rows])
            optimizer.zero_grad(set_to_none=True)
            ((losses * learns[:, rows]).sum(1) / learns[:, rows].sum(1).clamp(min=1)).sum().backward()
            optimizer.step()
        with torch.no_grad():
            losses = answer_losses(_logits(network, inputs, compared, slice(None)), better)
        on_epoch()
        if (loss := losses[left_out].mean().item()) < lowest:
            lowest, best = loss, epoch
            kept = copy.deepcopy(network.state_dict())
        elif epoch - best >= _PATIENCE:
            break
    network.load_state_dict(kept)
    return best


def answer_losses(logits: Tensor, better: Tensor) -> Tensor:
    """Return the negative log-likelihood of answers, (M, A), for logits (M, A) and targets `better` (A,)."""
    p = (1 - BY_CHANCE) * torch.sigmoid(logits) + BY_CHANCE / 2
    return nn.functional.binary_cross_entropy(p, better.expand_as(p), reduction="none")


def _logits(network: RewardNetwork, inputs: Tensor, compared: Compared, rows: I64 | slice) -> Tensor:
    """Return R(left) - R(right) for every network, (M, A)."""
    both = [torch.from_numpy(side[rows]) for side in (compared.left, compared.right)]
    returns = [network.members(inputs[side.reshape(-1)]).view(-1, *side.shape).sum(-1) for side in both]
    return returns[0] - returns[1]
