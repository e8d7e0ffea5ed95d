"""LeRobot policies that run many episodes at once.

A LeRobot policy keeps its memory (queues of actions, past observations, ensembles) in plain
attributes, one for all rows of a batch. Here every episode has its own copy of the policy, which
shares the weights and acts alone: it plans at its own times, and its actions are bit-identical
whatever other episodes run.

Diffusion policies are slow to plan, so episodes share calls of the network, which takes an eighth
of the time per plan. The last bits of a row's plan depend on the number of rows and on the row's
index, not on the contents of other rows. So every call has `ROWS` rows, and an episode's number
determines its row. Plans differ by rounding from LeRobot's own, which are computed with a single
row.
"""

import contextlib
import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.policies.utils import populate_queues
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import Tensor

from manip_il.learn.checkpoint import Checkpoint, in_one_line
from manip_il.learn.lerobot_policy import load_policy

Batch = dict[str, Any]
# rows per call; episodes in lockstep have consecutive numbers, so each has a row to itself
ROWS = 25


@dataclass
class _Episode:
    """An episode that runs. memory: a copy of the policy, for diffusion only its queues. seed:
    of this step's draws.
    """

    number: int
    instruction: str
    steps: int = 0
    seed: int = 0
    memory: Any = None


class EpisodePolicy:
    """A LeRobot policy with its processors and one memory per episode.

    `module` is the policy without any episode's memory.

    Args:
        checkpoint: The policy to load.
        device: Torch's device.
        task: Instruction for a policy that reads language, if `begin` gives an episode no other.
        trust: Whether to load models and code that the checkpoint names.

    Raises:
        ManipError: What `load_policy` raises.
    """

    def __init__(self, checkpoint: Checkpoint, device: str, task: str, trust: bool):
        self.module, self._before, self._after = load_policy(checkpoint, device, trust)
        self.module.reset()
        self._task = task
        self._device = torch.device(self.module.config.device or "cpu")
        shared = (self.module.config, *self.module.parameters(), *self.module.buffers())
        self._shared = {id(part): part for part in shared}
        self._episodes: dict[int, _Episode] = {}

    def select(self, batch: Batch, episodes: Sequence[int]) -> Tensor:
        """Return one action per row, (B, n).

        Episodes that are not listed have ended and are forgotten.
        """
        before = self._episodes
        self._episodes = {
            number: before.get(number) or _Episode(number, self._task) for number in episodes
        }
        running = [self._episodes[number] for number in episodes]
        for episode in running:
            sequence = np.random.SeedSequence([episode.number, episode.steps])
            episode.seed = int(sequence.generate_state(1, np.uint64)[0])
            episode.steps += 1
        # mixed precision if the policy was trained with it, as in lerobot-eval
        half = torch.autocast(self._device.type, enabled=self.module.config.use_amp)
        with in_one_line("the policy cannot act"), half:
            if self.module.config.type == "diffusion":
                actions = self._after(self._planned(self._observed(batch, running), running))
            else:
                alone = [
                    self._act_alone({key: value[i : i + 1] for key, value in batch.items()}, one)
                    for i, one in enumerate(running)
                ]
                actions = torch.cat(alone)
        return actions.to("cpu", torch.float32)

    def begin(self, instructions: Mapping[int, str]) -> None:
        """Drop the memory of episodes that begin, and set their instructions."""
        for number, text in instructions.items():
            self._episodes[number] = _Episode(number, text or self._task)

    def _act_alone(self, row: Batch, episode: _Episode) -> Tensor:
        if episode.memory is None:
            episode.memory = copy.deepcopy(self.module, dict(self._shared))
        with _drawing(episode.seed, self._device):
            return self._after(episode.memory.select_action(self._observed(row, [episode])))

    def _observed(self, batch: Batch, episodes: Sequence[_Episode]) -> Batch:
        return self._before({**batch, "task": [episode.instruction for episode in episodes]})

    def _planned(self, observed: Batch, episodes: Sequence[_Episode]) -> Tensor:
        """Return actions (B, n) as in `DiffusionPolicy.select_action`, row by row, still
        normalised.
        """
        policy: Any = self.module
        batch = {key: value for key, value in observed.items() if isinstance(value, Tensor)}
        if images := policy.config.image_features:
            batch[OBS_IMAGES] = torch.stack([batch[key] for key in images], dim=-4)
        for i, episode in enumerate(episodes):
            if episode.memory is None:
                policy.reset()
                episode.memory = policy._queues
            populate_queues(episode.memory, {key: value[i : i + 1] for key, value in batch.items()})
        while waiting := [episode for episode in episodes if not episode.memory[ACTION]]:
            self._plan({episode.number % ROWS: episode for episode in waiting})
        return torch.cat([episode.memory[ACTION].popleft() for episode in episodes])

    def _plan(self, block: Mapping[int, _Episode]) -> None:
        """Compute the next plans of some episodes, by their row of the network's batch."""
        policy: Any = self.module
        model, config = policy.diffusion, policy.config
        weight = next(model.parameters())
        generators = [
            torch.Generator(weight.device).manual_seed(block[row].seed if row in block else 0)
            for row in range(ROWS)
        ]
        batch: dict[str, Tensor] = {}
        for row, episode in block.items():
            for key, past in episode.memory.items():
                if key != ACTION:
                    asked = torch.stack(list(past), dim=1)
                    batch.setdefault(key, asked.new_zeros((ROWS, *asked.shape[1:])))[row] = asked[0]
        shape = (config.horizon, *config.action_feature.shape)
        noise = [
            torch.randn(shape, generator=generator, device=weight.device, dtype=weight.dtype)
            for generator in generators
        ]
        seen = model._prepare_global_conditioning(batch)
        # each row's generator also draws the noise of its denoising steps, which LeRobot's
        # `generate_actions` cannot do
        plans = model.conditional_sample(ROWS, seen, generators, torch.stack(noise))
        start = config.n_obs_steps - 1
        plans = plans[:, start : start + config.n_action_steps]
        for row, episode in block.items():
            episode.memory[ACTION].extend(plans[row : row + 1].transpose(0, 1))


@contextlib.contextmanager
def _drawing(seed: int, device: torch.device) -> Iterator[None]:
    """Seed torch's global generator for a `with` block; restore its state afterwards."""
    cuda = device.type == "cuda"
    with torch.random.fork_rng(devices=[device] if cuda else []):
        # not `torch.manual_seed`, which seeds every kind of device and takes as long as a step of a
        # small policy
        torch.default_generator.manual_seed(seed)
        if cuda:
            with torch.cuda.device(device):
                torch.cuda.manual_seed(seed)
        yield
