"""Limits of what torch takes: memory for the network that a checkpoint asks for, and threads.

A few bytes of `config.json` can ask for a thousand million layers. Its numbers are checked before LeRobot sees them,
and the tensors made of them are counted while they are made: no more than belong to the weights beside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, override

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from manip_il import checks
from manip_il.errors import ManipError

LARGEST = 10_000  # layers, units, steps: of any whole number in a policy's options
_LARGEST: dict[str, int] = {  # of numbers that only cost time when the policy acts
    "cem_iterations": 100,
    "horizon": 2_000,
    "n_obs_steps": 100,
    "num_inference_steps": 1_000,
    "num_train_timesteps": 1_000,
}
_OF_TRAINING = (  # beginnings of options that acting does not look at
    *("optimizer_", "scheduler_", "n_vqvae_training_steps"),
    *("online_", "offline_", "actor_learner_config", "concurrency"),
)
_ELSEWHERE = ("type", "input_features", "output_features")  # checked as an interface
_MOST_OF_TRAINING = 10**12
_A_TENSOR = 1_000  # what a tensor counts for beside its numbers: layers of nothing take memory, too
_BESIDE = 2**26  # numbers that are not saved with the weights: tables of positions, masks


def check_numbers(settings: Mapping[str, Any], source: str) -> None:
    """Raise `ManipError` for a whole number among a policy's options that no policy has."""
    for name, value in settings.items():
        if name not in _ELSEWHERE:
            training = name.startswith(_OF_TRAINING)
            _check(f"{source}: {name}", value, _MOST_OF_TRAINING if training else _LARGEST.get(name, LARGEST))


def _check(what: str, value: Any, most: int) -> None:
    if isinstance(value, int) and not isinstance(value, bool):
        checks.whole(what, value, -most, most)
    elif isinstance(value, str):
        checks.text(what, value)
    elif isinstance(value, list | dict):
        for one in value.values() if isinstance(value, dict) else value:
            _check(what, one, most)


class Budget(TorchDispatchMode):
    """A limit while it is active: no more tensors than twice those saved in a file of weights, and some beside.

    Raises `ManipError` before the memory is taken.
    """

    def __init__(self, weights: Path):
        super().__init__()
        self._weights = weights
        self._left = 2 * _stored(weights) + _BESIDE

    @override
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not any(isinstance(arg, Tensor) for arg in args):  # it makes one of nothing
            sizes = [arg for arg in args if isinstance(arg, list | tuple)]
            whole = sizes and all(isinstance(value, int) for value in sizes[0])
            self._left -= _A_TENSOR + (math.prod(sizes[0]) if whole else 0)
            if self._left < 0:
                raise ManipError(f"its options describe a much larger network than its weights ({self._weights.name})")
        return func(*args, **(kwargs or {}))


def _stored(weights: Path) -> int:
    """Numbers in a file of weights, with `_A_TENSOR` more for each of its tensors."""
    try:
        with safe_open(weights, framework="pt") as file:
            return sum(_A_TENSOR + math.prod(file.get_slice(name).get_shape()) for name in file.keys())  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ManipError(f"{weights.name} cannot be read: {error}") from error


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch use `count` threads inside.

    Its threads wait by spinning: two on one free core are tens of times slower than one.
    """
    before = torch.get_num_threads()
    if before != count:
        torch.set_num_threads(count)
    try:
        yield
    finally:
        if before != count:
            torch.set_num_threads(before)
