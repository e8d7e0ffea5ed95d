"""The actor that reinforcement learning begins with: new, or a clone's network with a spread of its own."""

from __future__ import annotations

from pathlib import Path

from safetensors.torch import load_file

from manip_il.data.schema import RobotTaskSpec
from manip_il.errors import MismatchError, UsageError
from manip_il.learn.action_spaces import Conversion, conversion_for
from manip_il.learn.checkpoint import check_fits, read_meta
from manip_il.learn.fit_config import EE_DELTA, MLP, FitConfig
from manip_il.learn.lerobot_config import LeRobotFit
from manip_il.learn.mlp.modeling_mlp import MLPPolicy
from manip_il.learn.network import fit_statistics
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.pretrained import WEIGHTS, check_interface, mlp_options, read_config, read_interface
from manip_il.learn.train import new_policy
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
    kind = read_config(start)["type"]
    if kind != MLP:
        raise UsageError(f"{start} is a policy of type {kind!r}; expected an mlp, whose actions have a density")
    loss = (mlp_options(start) or {})["loss"]
    if loss not in _CENTRED:
        raise UsageError(f"{start} was trained with loss {loss!r}; expected one of {', '.join(_CENTRED)}")
    if (meta := read_meta(start)) is not None:
        check_fits(meta, spec)
    interface = read_interface(start)
    check_interface(interface, spec)
    if space not in (None, interface.space):
        raise MismatchError("action space", str(start), interface.space, "--action_space", space)
    return conversion_for(interface.space, spec)


def start_policy(
    start: Path | None, space: str, spec: RobotTaskSpec, seed: int, rows: tuple[F32, F32] | None
) -> MLPPolicy:
    """Return an mlp with a Gaussian's loss. rows: raw inputs (N, d) and targets (N, n), which give a new one its units.

    A clone keeps its own units, and acts as it did.
    """
    options = {"type": MLP} if start is None else dict(mlp_options(start) or {})
    fit = FitConfig(policy={**options, "loss": _GAUSSIAN}, action_space=space, seed=seed)
    policy = new_policy(LeRobotFit(fit, spec.action_meaning), spec)
    if start is None:
        if rows is None:
            raise UsageError("no demonstrations and no policy to begin with; give --dataset.root=DIR or --init=RUN")
        policy.model.set_statistics(fit_statistics(*rows, _GAUSSIAN))
        return policy
    LearnedPolicy.load(start)  # which refuses what is not whole
    saved = {name.removeprefix("model."): tensor for name, tensor in load_file(start / WEIGHTS).items()}
    ours = policy.model.state_dict()
    policy.model.load_state_dict({**{name: ours[name] for name in ours if name not in saved}, **saved})
    return policy
