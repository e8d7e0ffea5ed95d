"""LeRobot's policies in many episodes at once.

They keep what they remember (queues of actions, past observations, ensembles) as plain attributes, one for all rows of
a batch. Here every episode has a copy of its own that shares the weights and acts alone: it plans at its own clock, and
its actions are the same bits whatever runs beside it. Diffusion policies, which take long to plan, share calls of their
network (`SharedPlans`).
"""

from __future__ import annotations

import contextlib
import copy
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy

from manip_il.errors import ManipError
from manip_il.learn.lerobot_policy import line_of
from manip_il.learn.shared_plans import SharedPlans

Batch = dict[str, Any]


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
        self._plans = SharedPlans(policy) if policy.config.type == "diffusion" else None
        self._instructions: dict[int, str] = {}
        self._steps = Counter[int]()  # taken in every episode
        self._memories: dict[int, PreTrainedPolicy] = {}

    def select(self, batch: Batch, episodes: Sequence[int]) -> torch.Tensor:
        """Return one action a row, (B, n). Episodes that are not among these have ended and are forgotten."""
        self.forget([episode for episode in self._steps if episode not in set(episodes)])
        try:
            # mixed precision where the policy was trained so, as lerobot-eval has it
            with torch.autocast(self._device.type) if self.module.config.use_amp else contextlib.nullcontext():
                if self._plans is not None:
                    generators = [torch.Generator(self._device).manual_seed(self._next_seed(one)) for one in episodes]
                    planned = self._plans.select(self._observed(batch, episodes), episodes, generators)
                    actions = [self._after(planned)]
                else:
                    actions = [self._one(_row(batch, i), episode) for i, episode in enumerate(episodes)]
        except ManipError:
            raise
        except Exception as error:  # the code of any policy, with options and statistics from anywhere
            raise ManipError(f"the policy cannot act: {type(error).__name__}: {line_of(error)}") from error
        return torch.cat([action.to("cpu", torch.float32) for action in actions])

    def forget(self, episodes: Iterable[int]) -> None:
        """Drop the memory of these episodes."""
        for episode in episodes:
            for kept in (self._memories, self._steps, self._instructions):
                kept.pop(episode, None)
            if self._plans is not None:
                self._plans.forget(episode)

    def instruct(self, instructions: Mapping[int, str]) -> None:
        """Take the texts of episodes that begin, by their numbers."""
        self._instructions.update({episode: text for episode, text in instructions.items() if text})

    def _one(self, row: Batch, episode: int) -> torch.Tensor:
        if episode not in self._memories:
            self._memories[episode] = copy.deepcopy(self.module, dict(self._shared))
        with _drawing(self._next_seed(episode), self._device):
            return self._after(self._memories[episode].select_action(self._observed(row, [episode])))

    def _observed(self, batch: Batch, episodes: Sequence[int]) -> Batch:
        return self._before({**batch, "task": [self._instructions.get(one, self._task) for one in episodes]})

    def _next_seed(self, episode: int) -> int:
        """The seed of what is drawn in an episode's next step."""
        step = self._steps[episode]
        self._steps[episode] += 1
        return int(np.random.SeedSequence([episode, step]).generate_state(1, np.uint64)[0])


def _row(batch: Batch, i: int) -> Batch:
    """One row of what is there for every episode, (1, ...)."""
    return {key: value[i : i + 1] if isinstance(value, torch.Tensor | list) else value for key, value in batch.items()}


def _shared(policy: PreTrainedPolicy) -> dict[int, Any]:
    """The parts that copies share, as a memo of `deepcopy`: weights, buffers, torch's own layers, the configuration."""
    layers = (
        module
        for module in policy.modules()
        if all(type(part).__module__.startswith(("torch.", "torchvision.")) for part in module.modules())
    )
    return {id(part): part for part in (policy.config, *policy.parameters(), *policy.buffers(), *layers)}


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
