"""LeRobot's policies: made for a fit, and loaded to act in many episodes at once.

They keep what they remember (queues of actions, past observations, ensembles) as plain attributes, one for all rows of
a batch. Here every episode has a copy of its own that shares the weights and acts alone: it plans at its own clock, and
its actions are the same bits whatever runs beside it. Diffusion policies, which take long to plan, share calls of their
network (`SharedPlans`).
"""

from __future__ import annotations

import contextlib
import copy
import io
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.error import URLError

import draccus
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy

from manip_il.data.schema import IMAGES
from manip_il.errors import ManipError, UnknownName
from manip_il.learn.action_spaces import Conversion
from manip_il.learn.action_steps import add_steps, expect_converted  # known here, they are known to what is loaded
from manip_il.learn.checkpoint import readable_state
from manip_il.learn.lerobot_config import policy_class, policy_types
from manip_il.learn.limits import Budget, check_numbers
from manip_il.learn.pretrained import (
    CONFIG,
    PLAIN,
    PROCESSORS,
    WEIGHTS,
    check_processors,
    processor_steps,
    read_config,
    require_trust,
)

if TYPE_CHECKING:  # it imports diffusers, which takes a second
    from manip_il.learn.shared_plans import SharedPlans

Batch = dict[str, Any]
_DEVICE_STEP = "device_processor"
_LONGEST = 300  # characters of another program's message
_SMALLEST = {"std": 1e-3, "range": 1e-2}  # [rad] or [m]: less than this in all of the data is noise, not scale


class EpisodePolicy:
    """A LeRobot policy with its processors and one memory an episode.

    module: the policy without a memory of any episode. task: instruction for one that reads language, in episodes that
    `instruct` gives no other.
    """

    def __init__(
        self,
        policy: PreTrainedPolicy,
        before: Callable[[Batch], Batch],
        after: Callable[[torch.Tensor], torch.Tensor],
        task: str = "",
    ):
        policy.reset()
        self.module, self._before, self._after, self._task = policy, before, after, task
        self._device = torch.device(policy.config.device or "cpu")
        self._shared = _shared(policy)
        self._plans = _plans_of(policy)
        self._instructions: dict[int, str] = {}
        self._memories: dict[int, tuple[PreTrainedPolicy, Iterator[int]]] = {}  # and the number of each step

    def select(self, batch: Batch, episodes: Sequence[int]) -> torch.Tensor:
        """Return one action a row, (B, n). Episodes that are not among these have ended and are forgotten."""
        self.forget(self._memories.keys() - set(episodes))
        try:
            # mixed precision where the policy was trained so, as lerobot-eval has it
            with torch.autocast(self._device.type) if self.module.config.use_amp else contextlib.nullcontext():
                if self._plans is not None:
                    actions = [self._together(self._plans, batch, episodes)]
                else:
                    actions = [self._one(_row(batch, i), episode) for i, episode in enumerate(episodes)]
        except ManipError:
            raise
        except Exception as error:  # the code of any policy, with options and statistics from anywhere
            raise ManipError(f"the policy cannot act: {type(error).__name__}: {_line(error)}") from error
        return torch.cat([action.to("cpu", torch.float32) for action in actions])

    def forget(self, episodes: Iterable[int]) -> None:
        """Drop the memory of these episodes."""
        for episode in episodes:
            self._memories.pop(episode, None)
            self._instructions.pop(episode, None)

    def instruct(self, instructions: Mapping[int, str]) -> None:
        """Take the texts of episodes that begin, by their numbers."""
        self._instructions.update({episode: text for episode, text in instructions.items() if text})

    def _one(self, row: Batch, episode: int) -> torch.Tensor:
        policy, step = self._remembered(episode)
        with _drawing(_seed(episode, step), self._device):
            return self._after(policy.select_action(self._observed(row, [episode])))

    def _together(self, plans: SharedPlans, batch: Batch, episodes: Sequence[int]) -> torch.Tensor:
        from manip_il.learn.shared_plans import Turn

        observed = self._observed(batch, episodes)
        turns: list[Turn] = []
        for i, episode in enumerate(episodes):
            policy, step = self._remembered(episode)
            generator = torch.Generator(self._device).manual_seed(_seed(episode, step))
            turns.append(Turn(episode, generator, policy, _row(observed, i)))
        plans.make(turns)
        return self._after(torch.cat([turn.memory.select_action(dict(turn.observation)) for turn in turns]))

    def _remembered(self, episode: int) -> tuple[PreTrainedPolicy, int]:
        """The policy with an episode's memory, and the number of this step."""
        if episode not in self._memories:
            policy = copy.deepcopy(self.module, dict(self._shared))
            if self._plans is not None:
                self._plans.serve(policy)
            self._memories[episode] = policy, itertools.count()
        policy, steps = self._memories[episode]
        return policy, next(steps)

    def _observed(self, batch: Batch, episodes: Sequence[int]) -> Batch:
        return self._before({**batch, "task": [self._instructions.get(one, self._task) for one in episodes]})


def _row(batch: Batch, i: int) -> Batch:
    """One row of what is there for every episode, (1, ...)."""
    return {key: value[i : i + 1] if isinstance(value, torch.Tensor | list) else value for key, value in batch.items()}


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
    """The parts that copies share, as a memo of `deepcopy`: weights, buffers, torch's own layers, the configuration."""
    layers = (
        module
        for module in policy.modules()
        if all(type(part).__module__.startswith(("torch.", "torchvision.")) for part in module.modules())
    )
    return {id(part): part for part in (policy.config, *policy.parameters(), *policy.buffers(), *layers)}


def _plans_of(policy: PreTrainedPolicy) -> SharedPlans | None:
    """Return the maker of plans for many episodes at once; None for a policy that plans row by row."""
    if policy.config.type != "diffusion":
        return None
    from manip_il.learn.shared_plans import SharedPlans

    return SharedPlans(policy)


def _seed(episode: int, step: int) -> int:
    """The seed of what is drawn in a step."""
    return int(np.random.SeedSequence([episode, step]).generate_state(1, np.uint64)[0])


@contextlib.contextmanager
def _drawing(seed: int, device: torch.device) -> Iterator[None]:
    """Let torch draw what depends on the seed alone; after it, the global generator is as before."""
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


def build_policy(config: PreTrainedConfig, meta: Any) -> PreTrainedPolicy:
    """Return LeRobot's policy, its weights new or from `config.pretrained_path`.

    Raises `ManipError` for a checkpoint that cannot be loaded, and with the two ways out where a backbone's weights
    would have to be downloaded and cannot be.
    """
    weights = getattr(config, "pretrained_backbone_weights", None)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # LeRobot prints, and standard output belongs to the caller
            policy = make_policy(config, ds_meta=meta) if config.pretrained_path is None else _loaded(config, meta)
    except (URLError, OSError) as error:
        if not weights or isinstance(error, FileNotFoundError):
            raise
        raise ManipError(
            f"cannot download {weights} ({error}): train from scratch with --policy.pretrained_backbone_weights=null, "
            f"or put the file that torchvision names into {torch.hub.get_dir()}/checkpoints"
        ) from error
    except ImportError as error:
        raise ManipError(f"--policy.type={config.type} needs more packages: {error}") from error
    if weights:  # a checkpoint has its own: it shall load where there is no network
        config.pretrained_backbone_weights = None  # pyright: ignore[reportAttributeAccessIssue]
    config.pretrained_path = None
    return policy


def _loaded(config: PreTrainedConfig, meta: Any) -> PreTrainedPolicy:
    """The policy with the weights in `config.pretrained_path`."""
    path = Path(str(config.pretrained_path))
    try:
        with Budget(path / WEIGHTS) if config.type in PLAIN else contextlib.nullcontext():
            return make_policy(config, ds_meta=meta)
    except ImportError:
        raise
    except Exception as error:  # weights from anywhere, read by the code of any policy: errors of every kind
        raise ManipError(f"{path} does not fit this policy: {type(error).__name__}: {_line(error)}") from error


def build_processors(
    config: PreTrainedConfig,
    meta: Any,
    checkpoint: Path | None,
    *,
    trust: bool = False,
    conversion: Conversion | None = None,
) -> tuple[Any, Any]:
    """Return LeRobot's pre- and postprocessor, with the dataset's statistics, on going on with the checkpoint's.

    conversion: of the actions, which the dataset's metadata then has, where the processors are to carry one. Raises
    what `require_trust` raises for the checkpoint's, and `ManipError` where they cannot be read.
    """
    if checkpoint is None:
        before, after = make_pre_post_processors(config, dataset_stats=usable_statistics(meta.stats), dataset_meta=meta)
        if conversion is not None:
            add_steps(before, after, conversion)
            expect_converted(before)
        return before, after
    check_processors(checkpoint)
    require_trust(read_config(checkpoint), str(checkpoint), trust, checkpoint)
    device = {"device_processor": {"device": config.device}}
    with readable_state(checkpoint):
        before, after = make_pre_post_processors(config, str(checkpoint), preprocessor_overrides=device)
    expect_converted(before)
    return before, after


def usable_statistics(stats: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return a dataset's statistics with a least deviation and range for vectors.

    Without it, a joint that hardly moved in the data would be many deviations off wherever it does move.
    """
    usable: dict[str, dict[str, Any]] = {}
    for key, values in stats.items():
        usable[key] = own = {name: np.array(value) for name, value in values.items()}
        if key.startswith(IMAGES) or "std" not in own:
            continue
        own["std"] = np.maximum(own["std"], _SMALLEST["std"])
        for low, high in (("min", "max"), ("q01", "q99"), ("q10", "q90")):
            if low in own and high in own:
                own[high] = np.maximum(own[high], own[low] + _SMALLEST["range"])
    return usable
