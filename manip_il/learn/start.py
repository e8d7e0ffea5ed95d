"""The actor that reinforcement learning begins with: new, or a clone's network with a spread of its own."""

from __future__ import annotations

from pathlib import Path

import torch
from lerobot.policies.factory import make_pre_post_processors

from manip_il.data.schema import ENVIRONMENT_STATE, STATE, RobotTaskSpec, features
from manip_il.errors import MismatchError, UsageError
from manip_il.learn.action_spaces import Conversion, conversion_for
from manip_il.learn.action_steps import add_steps, is_in_processors
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.lerobot_config import policy_features
from manip_il.learn.mlp import MLPConfig, MLPPolicy
from manip_il.learn.names import EE_DELTA, MLP
from manip_il.learn.network import fit_statistics, read_weights
from manip_il.learn.transitions import F32

_GAUSSIAN = "gaussian"
_CENTRED = ("mse", "l1", _GAUSSIAN)  # losses whose outputs are the mean of an action


def start_conversion(start: Path | None, space: str | None, spec: RobotTaskSpec) -> Conversion:
    """Return the way to the actor's actions: in the clone's space, else in `space`, by default that of the hand.

    Raises `UsageError` for a `start` that cannot be gone on from, `MismatchError` for one for other data, and what
    `conversion_for` raises.
    """
    if start is None:
        return conversion_for(space or EE_DELTA, spec)
    checkpoint = Checkpoint.open(start)
    if checkpoint.kind != MLP:
        raise UsageError(
            f"{start} is a policy of type {checkpoint.kind!r}; expected an mlp, whose actions have a density"
        )
    if (loss := checkpoint.config["loss"]) not in _CENTRED:
        raise UsageError(f"{start} was trained with loss {loss!r}; expected one of {', '.join(_CENTRED)}")
    checkpoint.check_fits(spec)
    if space not in (None, checkpoint.space):
        raise MismatchError("action space", str(start), checkpoint.space, "--action_space", space)
    return conversion_for(checkpoint.space, spec)


def start_policy(start: Path | None, space: str, spec: RobotTaskSpec, rows: tuple[F32, F32] | None) -> MLPPolicy:
    """Return an mlp with a Gaussian's loss. rows: raw inputs (N, d) and targets (N, n), which give a new one its units.

    A clone keeps its own units, and acts as it did. Weights are drawn from torch's global generator.
    """
    options = (None if start is None else Checkpoint.open(start).mlp_options) or {}
    options |= {"loss": _GAUSSIAN, "action_space": space}
    config = MLPConfig(**{name: value for name, value in options.items() if name != "type"})
    inputs = [STATE, *([ENVIRONMENT_STATE] if spec.environment_state_names else [])]
    config.input_features, config.output_features = policy_features(features(spec), inputs)
    policy = MLPPolicy(config)
    if start is not None:
        policy.model.load_state_dict({**policy.model.state_dict(), **read_weights(start)})
    elif rows is not None:
        inputs = policy.model.expanded(torch.from_numpy(rows[0])).numpy()
        policy.model.set_statistics(fit_statistics(inputs, rows[1], _GAUSSIAN))
    else:
        raise UsageError("no demonstrations and no policy to begin with; give --dataset.root=DIR or --init=RUN")
    return policy


def save_policy(policy: MLPPolicy, conversion: Conversion, folder: Path) -> None:
    """Write configuration, weights and processors of an mlp to a new folder, as LeRobot has them."""
    folder.mkdir()
    policy.save_pretrained(folder)
    processors = make_pre_post_processors(policy.config)
    if is_in_processors(policy.config.type, conversion):
        add_steps(*processors, conversion)
    for processor in processors:
        processor.save_pretrained(folder)
