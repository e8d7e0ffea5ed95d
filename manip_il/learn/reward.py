"""A reward of states and actions, and the one that was learnt from preferences, read without LeRobot."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError, NotFiniteError
from manip_il.learn.checkpoint import CONFIG, Origin, read_config, read_origin
from manip_il.learn.network import read_weights
from manip_il.learn.preference.network import RewardNetwork, RewardShape
from manip_il.learn.threads import threads

F32 = NDArray[np.float32]
PREFERENCE = "preference"  # its type, in LeRobot's config.json
INPUTS = (STATE, ENVIRONMENT_STATE, ACTION)
_ROWS = 16_384  # evaluated at once


class Reward(Protocol):
    """A reward of what was seen and done."""

    def __call__(self, states: F32, environment_states: F32, actions: F32) -> F32:
        """Return the reward of every row, (B,): states (B, n), environment states (B, k), absolute actions (B, n)."""
        ...


class LearnedReward:
    """A reward that was learnt from preferences. origin: robot, task and columns that it is for.

    About 0 at the poorest and 1 at the best of the states it was learnt on.
    """

    def __init__(self, network: RewardNetwork, origin: Origin) -> None:
        self.network, self.origin = network.eval(), origin
        self._widths = len(origin.joint_names), len(origin.environment_state_names), len(origin.joint_names)

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
            raise ManipError(f"{path} does not say for which robot and task it is: manip_il.json is missing")
        width = sum(_width(path, config, key) for key in INPUTS)
        reward = cls(_read_network(path, config, width), origin)
        if width != sum(reward._widths):
            raise MismatchError("width of the inputs", str(path / CONFIG), width, "manip_il.json", sum(reward._widths))
        return reward

    def check_fits(self, name: str, spec: RobotTaskSpec) -> None:
        """Raise `MismatchError` unless a dataset's columns, and its task, are those of this reward. name: of it."""
        if self.origin.task != spec.task:
            raise MismatchError("task", "the reward", self.origin.task, name, spec.task)
        self.origin.check_fits(spec)

    def __call__(self, states: F32, environment_states: F32, actions: F32) -> F32:
        """Return the reward of every row, (B,); see `Reward`. Raises `MismatchError` for other widths."""
        given = (states, environment_states, actions)
        for key, one, width in zip(INPUTS, given, self._widths, strict=True):
            if one.ndim != 2 or one.shape != (len(states), width):
                raise MismatchError(f"shape of {key}", "the reward", f"({len(states)}, {width})", "the rows", one.shape)
        return self.of_inputs(np.concatenate(given, axis=1, dtype=np.float32))

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


def _width(path: Path, config: dict[str, Any], key: str) -> int:
    feature = checks.mapping(f"{path / CONFIG}: {key}", config["input_features"].get(key))
    shape = checks.array(f"{path / CONFIG}: shape of {key}", feature.get("shape"), 1)
    return math.prod(checks.whole(f"{path / CONFIG}: width of {key}", side, 1, 100_000) for side in shape)


def _read_network(path: Path, config: dict[str, Any], width: int) -> RewardNetwork:
    try:
        lists: dict[str, Any] = {name: tuple(checks.array(name, config.get(name, []))) for name in ("ways", "unread")}
        sizes: dict[str, Any] = {name: config.get(name) for name in ("members", "width", "depth")}
        shape = RewardShape(**sizes, **lists, logarithms=checks.truth("logarithms", config.get("logarithms", False)))
        network = RewardNetwork(width, shape)
        network.load_state_dict(read_weights(path))
    except (ManipError, RuntimeError) as error:
        raise ManipError(f"{path} cannot be read: {checks.one_line(error)}") from error
    return network
