"""Any LeRobot policy, for many episodes at once.

LeRobot's policies keep what they remember (queues of actions, past observations, ensembles) as plain attributes, one
for all rows of a batch. Here every episode has a copy of its own that shares the weights, and is asked alone: it plans
at its own clock, and its actions are the same bits whatever runs beside it.
"""

from __future__ import annotations

import contextlib
import copy
import io
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy

from manip_il.errors import ManipError, UnknownName
from manip_il.learn.choices import policy_class, policy_types
from manip_il.learn.limits import Budget, check_numbers
from manip_il.learn.pretrained import CONFIG, PROCESSORS, WEIGHTS, check_processors, processor_steps
from manip_il.learn.trust import PLAIN, require_trust

Batch = dict[str, Any]
_DEVICE_STEP = "device_processor"
_LONGEST = 300  # characters of another program's message


@dataclass(slots=True)
class _Memory:
    policy: PreTrainedPolicy
    step: int = 0


class EpisodePolicy:
    """A LeRobot policy with its processors; remembers each episode apart.

    task: what a policy that reads language is told to do.
    """

    def __init__(
        self,
        policy: PreTrainedPolicy,
        before: Callable[[Batch], Batch],
        after: Callable[[torch.Tensor], torch.Tensor],
        task: str = "",
    ):
        policy.reset()
        self._fresh, self._before, self._after, self._task = policy, before, after, task
        self._device = torch.device(policy.config.device or "cpu")
        self._shared = _shared(policy)
        self._memories: dict[int, _Memory] = {}

    @property
    def module(self) -> PreTrainedPolicy:
        """LeRobot's policy, which has seen no episode."""
        return self._fresh

    def select(self, batch: Batch, episodes: Sequence[int]) -> torch.Tensor:
        """Return one action a row, (B, n). Episodes that are not among these have ended and are forgotten."""
        self.forget(self._memories.keys() - set(episodes))
        rows = ({key: values[i : i + 1] for key, values in batch.items()} for i in range(len(episodes)))
        try:
            actions = [self._one(row, episode) for row, episode in zip(rows, episodes, strict=True)]
        except ManipError:
            raise
        except Exception as error:  # the code of any policy, with options and statistics from anywhere
            raise ManipError(f"the policy cannot act: {type(error).__name__}: {_line(error)}") from error
        return torch.cat([action.to("cpu", torch.float32) for action in actions])

    def forget(self, episodes: Iterable[int]) -> None:
        """Drop what is remembered of these."""
        for episode in episodes:
            self._memories.pop(episode, None)

    def _one(self, row: Batch, episode: int) -> torch.Tensor:
        if episode not in self._memories:
            self._memories[episode] = _Memory(copy.deepcopy(self._fresh, dict(self._shared)))
        memory = self._memories[episode]
        with _drawing(episode, memory.step, self._device):
            seen = self._before({**row, "task": [self._task]})
            with self._precision():
                action = memory.policy.select_action(seen)
            memory.step += 1
            return self._after(action)

    def _precision(self) -> contextlib.AbstractContextManager[Any]:
        """Mixed, where the policy was trained so, as lerobot-eval has it."""
        return torch.autocast(self._device.type) if self._fresh.config.use_amp else contextlib.nullcontext()


def load_policy(path: Path, settings: Mapping[str, Any], device: str, task: str, trust: bool = False) -> EpisodePolicy:
    """Return the policy in a `pretrained_model` folder, without a network where LeRobot needs none.

    settings: its `config.json`. Raises `UnknownName` for a type that is not known, `ManipError` where packages are
    missing, where what it names would have to be trusted and is not (`require_trust`), or where LeRobot cannot load
    the folder.
    """
    kind = settings["type"]
    if kind not in policy_types():
        raise UnknownName(f"policy type in {path / CONFIG}:", kind, policy_types())
    check_processors(path)
    require_trust(settings, str(path), trust, path)
    if kind in PLAIN:
        check_numbers(settings, str(path / CONFIG))
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # LeRobot prints, and standard output belongs to the caller
            return EpisodePolicy(*_load(path, settings, device), task)
    except ImportError as error:
        raise ManipError(f"{path} is a policy of type {kind!r}, which needs more packages: {_line(error)}") from error
    except ManipError as error:
        raise ManipError(f"{path}: {error}") from error
    except Exception as error:  # a folder from anywhere, read by the code of any policy: errors of every kind
        if "state_dict" in str(error):
            raise ManipError(f"{path}: weights and {CONFIG} do not match: {_line(error)}") from error
        raise ManipError(f"{path}: LeRobot cannot load it: {type(error).__name__}: {_line(error)}") from error


def _load(path: Path, settings: Mapping[str, Any], device: str) -> tuple[PreTrainedPolicy, Any, Any]:
    kind, own = settings["type"], {key: value for key, value in settings.items() if key != "type"}
    # Not `PreTrainedConfig.from_pretrained`, which leaves a temporary file behind each time
    config = draccus.decode(policy_class(kind), own | {"device": device})
    # Weights come from the checkpoint; torchvision would download its own first.
    if hasattr(config, "pretrained_backbone_weights"):
        config.pretrained_backbone_weights = None  # pyright: ignore[reportAttributeAccessIssue]
    # Frozen parts of others are fetched and no part of the weights
    with Budget(path / WEIGHTS) if kind in PLAIN else contextlib.nullcontext():
        policy = get_policy_class(kind).from_pretrained(path, config=config, strict=True)
    placed = any(step["registry_name"] == _DEVICE_STEP for step in processor_steps(path / PROCESSORS[0]))
    overrides = {_DEVICE_STEP: {"device": device}} if placed else {}
    before, after = make_pre_post_processors(config, str(path), preprocessor_overrides=overrides)
    return policy, before, after


def _shared(policy: PreTrainedPolicy) -> dict[int, Any]:
    """What copies have in common, as `deepcopy` wants it: weights, buffers, torch's own layers, the configuration."""
    shared: dict[int, Any] = {id(policy.config): policy.config}
    for tensor in itertools.chain(policy.parameters(), policy.buffers()):
        shared[id(tensor)] = tensor
    for module in policy.modules():
        if all(type(part).__module__.startswith(("torch.", "torchvision.")) for part in module.modules()):
            shared[id(module)] = module
    return shared


@contextlib.contextmanager
def _drawing(episode: int, step: int, device: torch.device) -> Iterator[None]:
    """Let torch draw what depends on episode and step alone; after it, the global generator is as before."""
    seed = int(np.random.SeedSequence([episode, step]).generate_state(1, np.uint64)[0])
    cuda = device.type == "cuda"
    with torch.random.fork_rng(devices=[device] if cuda else []):
        # Not `torch.manual_seed`, which visits every kind of device and takes as long as a small policy.
        torch.default_generator.manual_seed(seed)
        if cuda:
            with torch.cuda.device(device):
                torch.cuda.manual_seed(seed)
        yield


def _line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
