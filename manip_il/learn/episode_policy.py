"""LeRobot policies that run many episodes at once.

A LeRobot policy keeps its memory (queues of actions, past observations, ensembles) in plain attributes, one for all
rows of a batch. Here every episode has its own copy of the policy, which shares the weights and acts alone: it plans at
its own times, and its actions are bit-identical whatever other episodes run.

Diffusion policies are slow to plan, so episodes share calls of the network, which takes an eighth of the time per plan.
The last bits of a row's plan depend on the number of rows and on the row's index, not on the contents of other rows.
So every call has `ROWS` rows, and an episode's number determines its row. Plans differ by rounding from LeRobot's own,
which are computed with a single row.
"""

from __future__ import annotations

import contextlib
import copy
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.policies.utils import populate_queues
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import Tensor

from manip_il.learn.checkpoint import in_one_line

Batch = dict[str, Any]
ROWS = 25  # rows per call; episodes in lockstep have consecutive numbers, so each has a row to itself


class EpisodePolicy:
    """A LeRobot policy with its processors and one memory per episode.

    module: the policy without any episode's memory. task: instruction for a policy that reads language, if
    `begin` gives an episode no other.
    """

    def __init__(
        self,
        policy: PreTrainedPolicy,
        before: Callable[[Batch], Batch],
        after: Callable[[Tensor], Tensor],
        task: str = "",
    ):
        policy.reset()
        self.module = policy
        self._before = before
        self._after = after
        self._task = task
        self._device = torch.device(policy.config.device or "cpu")
        self._shared = {id(part): part for part in (policy.config, *policy.parameters(), *policy.buffers())}
        self._instructions: dict[int, str] = {}
        self._steps = Counter[int]()  # steps taken in every episode
        self._memories: dict[int, Any] = {}  # a copy of the policy; for diffusion only its queues

    def select(self, batch: Batch, episodes: Sequence[int]) -> Tensor:
        """Return one action per row, (B, n). Episodes that are not listed have ended and are forgotten."""
        self._forget([episode for episode in self._steps if episode not in set(episodes)])
        seeds = [self._next_seed(episode) for episode in episodes]
        # mixed precision if the policy was trained with it, as in lerobot-eval
        half = torch.autocast(self._device.type) if self.module.config.use_amp else contextlib.nullcontext()
        with in_one_line("the policy cannot act"), half:
            if self.module.config.type == "diffusion":
                actions = self._after(self._planned(self._observed(batch, episodes), episodes, seeds))
            else:
                rows = [{key: value[i : i + 1] for key, value in batch.items()} for i in range(len(episodes))]
                actions = torch.cat([self._one(*row) for row in zip(rows, episodes, seeds, strict=True)])
        return actions.to("cpu", torch.float32)

    def begin(self, instructions: Mapping[int, str]) -> None:
        """Drop the memory of episodes that begin, and set their instructions."""
        self._forget(instructions)
        self._instructions.update({episode: text for episode, text in instructions.items() if text})

    def _forget(self, episodes: Iterable[int]) -> None:
        for episode in episodes:
            for kept in (self._memories, self._steps, self._instructions):
                kept.pop(episode, None)

    def _one(self, row: Batch, episode: int, seed: int) -> Tensor:
        if episode not in self._memories:
            self._memories[episode] = copy.deepcopy(self.module, dict(self._shared))
        with _drawing(seed, self._device):
            return self._after(self._memories[episode].select_action(self._observed(row, [episode])))

    def _observed(self, batch: Batch, episodes: Sequence[int]) -> Batch:
        return self._before({**batch, "task": [self._instructions.get(one, self._task) for one in episodes]})

    def _next_seed(self, episode: int) -> int:
        """Return the random seed of an episode's next step."""
        step = self._steps[episode]
        self._steps[episode] += 1
        return int(np.random.SeedSequence([episode, step]).generate_state(1, np.uint64)[0])

    def _planned(self, observed: Batch, episodes: Sequence[int], seeds: Sequence[int]) -> Tensor:
        """Return actions (B, n) as in `DiffusionPolicy.select_action`, row by row, still normalised."""
        policy: Any = self.module
        batch = {key: value for key, value in observed.items() if isinstance(value, Tensor)}
        if images := policy.config.image_features:
            batch[OBS_IMAGES] = torch.stack([batch[key] for key in images], dim=-4)
        waiting: dict[int, list[tuple[int, int]]] = defaultdict(list)
        for i, (episode, seed) in enumerate(zip(episodes, seeds, strict=True)):
            if episode not in self._memories:
                policy.reset()
                self._memories[episode] = policy._queues
            queues = populate_queues(self._memories[episode], {key: value[i : i + 1] for key, value in batch.items()})
            if not queues[ACTION]:
                waiting[episode % ROWS].append((episode, seed))
        while waiting:
            self._plan({row: asked.pop(0) for row, asked in waiting.items()})
            waiting = defaultdict(list, {row: asked for row, asked in waiting.items() if asked})
        return torch.cat([self._memories[episode][ACTION].popleft() for episode in episodes])

    def _plan(self, block: Mapping[int, tuple[int, int]]) -> None:
        """Compute the next plans of some episodes. block: row of the network's batch -> (episode, seed)."""
        policy: Any = self.module
        model, config = policy.diffusion, policy.config
        weight = next(model.parameters())
        generators = [torch.Generator(weight.device) for _ in range(ROWS)]
        batch: dict[str, Tensor] = {}
        for row, (episode, seed) in block.items():
            generators[row].manual_seed(seed)
            for key, past in self._memories[episode].items():
                if key != ACTION:
                    asked = torch.stack(list(past), dim=1)
                    batch.setdefault(key, asked.new_zeros((ROWS, *asked.shape[1:])))[row] = asked[0]
        shape = (config.horizon, *config.action_feature.shape)
        noise = [torch.randn(shape, generator=one, device=weight.device, dtype=weight.dtype) for one in generators]
        seen = model._prepare_global_conditioning(batch)
        # each row's generator also draws the noise of its denoising steps, which LeRobot's `generate_actions` cannot do
        plans = model.conditional_sample(ROWS, seen, generators, torch.stack(noise))
        start = config.n_obs_steps - 1
        plans = plans[:, start : start + config.n_action_steps]
        for row, (episode, _) in block.items():
            self._memories[episode][ACTION].extend(plans[row : row + 1].transpose(0, 1))


@contextlib.contextmanager
def _drawing(seed: int, device: torch.device) -> Iterator[None]:
    """Seed torch's global generator for a `with` block; restore its state afterwards."""
    cuda = device.type == "cuda"
    with torch.random.fork_rng(devices=[device] if cuda else []):
        # not `torch.manual_seed`, which seeds every kind of device and takes as long as a step of a small policy
        torch.default_generator.manual_seed(seed)
        if cuda:
            with torch.cuda.device(device):
                torch.cuda.manual_seed(seed)
        yield
