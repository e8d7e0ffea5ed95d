"""Plans of a diffusion policy for many episodes in one call of the network: an eighth of the time a plan.

In its last bits a row's plan depends on how many rows there are and which of them it is, not on what the others hold.
So every call has `ROWS` rows, and an episode's number says which is its own: its plan is the same bits whatever runs
beside it. LeRobot's own, of one row, differs from it by rounding.
"""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.policies.utils import populate_queues
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import Tensor

ROWS = 25  # of the episodes that run in lockstep, whose numbers follow each other: each has a row to itself


class SharedPlans:
    """The actions of LeRobot's `DiffusionPolicy` in many episodes: as its `select_action` has them, row by row."""

    def __init__(self, policy: PreTrainedPolicy):
        self._policy: Any = policy
        self._queues: dict[int, dict[str, Any]] = {}  # of every episode: past observations, and planned actions

    def forget(self, episode: int) -> None:
        """Drop the memory of an episode."""
        self._queues.pop(episode, None)

    def select(
        self, observed: Mapping[str, Any], episodes: Sequence[int], generators: Sequence[torch.Generator]
    ) -> Tensor:
        """Return an action a row (B, n), not yet in the data's units. generators: of each row, for what is drawn."""
        batch = {key: value for key, value in observed.items() if isinstance(value, Tensor)}
        if images := self._policy.config.image_features:
            batch[OBS_IMAGES] = torch.stack([batch[key] for key in images], dim=-4)
        waiting: dict[int, list[tuple[int, torch.Generator]]] = defaultdict(list)
        for i, episode in enumerate(episodes):
            if episode not in self._queues:
                self._policy.reset()
                self._queues[episode] = self._policy._queues
            queues = populate_queues(self._queues[episode], {key: value[i : i + 1] for key, value in batch.items()})
            if not queues[ACTION]:
                waiting[episode % ROWS].append((episode, generators[i]))
        while waiting:
            self._plan({row: asked.pop(0) for row, asked in waiting.items()})
            waiting = defaultdict(list, {row: asked for row, asked in waiting.items() if asked})
        return torch.cat([self._queues[episode][ACTION].popleft() for episode in episodes])

    def _plan(self, block: Mapping[int, tuple[int, torch.Generator]]) -> None:
        """Make the plans of the episodes in these rows, each with its generator."""
        model, config = self._policy.diffusion, self._policy.config
        weight = next(model.parameters())
        generators = [torch.Generator(weight.device) for _ in range(ROWS)]
        batch: dict[str, Tensor] = {}
        for row, (episode, generator) in block.items():
            generators[row] = generator
            for key, past in self._queues[episode].items():
                if key != ACTION:
                    asked = torch.stack(list(past), dim=1)
                    batch.setdefault(key, asked.new_zeros((ROWS, *asked.shape[1:])))[row] = asked[0]
        shape = (config.horizon, *config.action_feature.shape)
        noise = [torch.randn(shape, generator=one, device=weight.device, dtype=weight.dtype) for one in generators]
        with _drawing_from(model.noise_scheduler, generators):
            plans = model.generate_actions(batch, noise=torch.stack(noise))
        for row, (episode, _) in block.items():
            self._queues[episode][ACTION].extend(plans[row : row + 1].transpose(0, 1))


@contextlib.contextmanager
def _drawing_from(scheduler: Any, generators: Sequence[torch.Generator]) -> Iterator[None]:
    """Let a noise scheduler draw each row's noise from a generator of its own."""
    own = scheduler.step

    def step(*args: Any, generator: None = None, **kwargs: Any) -> Any:
        return own(*args, generator=generators, **kwargs)

    scheduler.step = step
    try:
        yield
    finally:
        del scheduler.step
