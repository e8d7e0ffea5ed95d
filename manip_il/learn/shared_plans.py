"""Plans of diffusion policies for many episodes in one call of the network: an eighth of the time a plan.

In its last bits a row's plan depends on how many rows there are and which of them it is, not on what the others hold.
So every call has `ROWS` rows, and an episode's number says which is its own: its plan is the same bits whatever runs
beside it. LeRobot's own, of one row, differs from it by rounding.
"""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor

ROWS = 25  # of the episodes that run in lockstep, whose numbers follow each other: each has a row to itself


@dataclass
class Turn:
    """One episode's step: its number, a generator of its own, its memory, and what it observes (1, ...)."""

    episode: int
    generator: torch.Generator
    memory: Any
    observation: Mapping[str, Any]


class _Asked(Exception):
    def __init__(self, batch: dict[str, Tensor]):
        self.batch = batch


class _Desk:
    """Stands for an episode's network: hands out the plan that was made for it, else raises what it was asked."""

    plan: Tensor | None = None

    def __call__(self, batch: dict[str, Tensor], noise: Tensor | None = None) -> Tensor:
        if self.plan is None:
            raise _Asked(batch)
        plan, self.plan = self.plan, None
        return plan


class SharedPlans:
    """Makes the plans of episodes whose memories are copies of one policy."""

    def __init__(self, policy: PreTrainedPolicy):
        self._policy: Any = policy  # LeRobot's DiffusionPolicy

    def serve(self, memory: Any) -> None:
        """Have an episode's memory, a copy of the policy, take its plans from here."""
        memory.diffusion.generate_actions = _Desk()

    def make(self, turns: Sequence[Turn]) -> None:
        """Make a plan for every episode that has come to the end of its last one."""
        waiting: dict[int, list[tuple[Turn, dict[str, Tensor]]]] = defaultdict(list)
        for turn in turns:
            if not turn.memory._queues[ACTION]:
                waiting[turn.episode % ROWS].append((turn, _question(turn)))
        while waiting:
            block = {row: asked.pop(0) for row, asked in waiting.items()}
            waiting = defaultdict(list, {row: asked for row, asked in waiting.items() if asked})
            self._plan(block)

    def _plan(self, block: Mapping[int, tuple[Turn, dict[str, Tensor]]]) -> None:
        model, config = self._policy.diffusion, self._policy.config
        _, first = next(iter(block.values()))
        batch = {key: value.new_zeros((ROWS, *value.shape[1:])) for key, value in first.items()}
        device = next(model.parameters()).device
        generators = [torch.Generator(device) for _ in range(ROWS)]
        for row, (turn, asked) in block.items():
            generators[row] = turn.generator
            for key, value in asked.items():
                batch[key][row] = value[0]
        shape, dtype = (config.horizon, *config.action_feature.shape), next(model.parameters()).dtype
        noise = [torch.randn(shape, generator=one, device=device, dtype=dtype) for one in generators]
        with _drawing_from(model.noise_scheduler, generators):
            plans = model.generate_actions(batch, noise=torch.stack(noise))
        for row, (turn, _) in block.items():
            turn.memory.diffusion.generate_actions.plan = plans[row : row + 1]


def _question(turn: Turn) -> dict[str, Tensor]:
    """Return what an episode's network would be asked now; its memory stays as it is."""
    policy = turn.memory
    queues = {key: queue.copy() for key, queue in policy._queues.items()}
    try:
        policy.select_action(dict(turn.observation))
    except _Asked as asked:
        return asked.batch
    finally:
        policy._queues = queues
    raise AssertionError("a policy with nothing planned asked for no plan")


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
