"""Episodes of equal length: those that the learner runs in lockstep, and the demonstrations padded
like them.

Learning needs episodes of equal length H: if an episode that succeeds ends early, a reward that is
positive (or negative) everywhere rewards (or punishes) staying alive, whatever was demonstrated
(Kostrikov et al., Discriminator-actor-critic, ICLR 2019, section 4.2; Orsini et al., What matters
for adversarial imitation learning?, NeurIPS 2021, section 4). So an episode that has ended
continues in an absorbing state, marked by a flag, until step H. Nothing is simulated there.
Demonstrations are padded in the same way.

An episode ends `hold` steps after success, as the demonstrations do. It must not continue at the
goal instead: nobody demonstrated how to stay there for long, so the learner's many states there
would look unlike the demonstrations' few, and arriving late would pay off. The learner spends the
same share of time in the absorbing state as the demonstrations if and only if it arrives as fast as
they do.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from manip_il.data.dataset import joined_columns
from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.data.schema import ACTION, ACTOR, ENVIRONMENT_STATE, LABEL_VALID, STATE, SUCCESS
from manip_il.errors import NothingToLearnError, UsageError
from manip_il.learn.action_spaces import Conversion
from manip_il.learn.network import MLPNetwork
from manip_il.mdp import F32, F64, Actor, require_finite
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import make_env


@dataclass(frozen=True, eq=False)
class Transitions:
    """Steps of episodes, N rows.

    Attributes:
        states: Raw inputs and the flag of the absorbing state, (N, d + 1).
        actions: Actions, normalised as for the policy's head and clipped to their range, (N, n).
        next_states: The states one step later, (N, d + 1).
    """

    states: F32
    actions: F32
    next_states: F32

    def __len__(self) -> int:
        return len(self.states)

    @property
    def absorbing(self) -> NDArray[np.bool_]:
        """Whether each row's state is absorbing, (N,)."""
        return self.states[:, -1] > 0


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """Whole episodes of the expert, in a policy's action space.

    Attributes:
        inputs: Raw inputs of each episode, (T, d).
        targets: Raw targets of each episode, (T, n).
        hold: Control steps from success to the end; None for episodes that do not end, as in a
            benchmark's environments.
    """

    inputs: tuple[F32, ...]
    targets: tuple[F32, ...]
    hold: int | None

    @property
    def longest(self) -> int:
        """Number of frames in the longest episode."""
        return max(map(len, self.inputs))

    @cached_property
    def stacked(self) -> tuple[F32, F32]:
        """Return all inputs (N, d) and targets (N, n), raw."""
        return np.concatenate(self.inputs), np.concatenate(self.targets)

    def padded(self, steps: int, network: MLPNetwork) -> Transitions:
        """Return all episodes, each padded to `steps` transitions, or not padded if `hold` is None.

        Args:
            steps: Transitions of a padded episode.
            network: The policy, which normalises the targets within its range.

        Raises:
            UsageError: If an episode is longer than `steps`.
        """
        if self.longest > steps:
            raise UsageError(
                f"episode_steps is {steps}; expected at least {self.longest}, the steps of the"
                " longest demonstration"
            )
        made = list[tuple[F32, F32, F32]]()
        for inputs, targets in zip(self.inputs, self.targets, strict=True):
            more = 0 if self.hold is None else max(1, steps - len(inputs) + 1)
            states = np.pad(inputs, ((0, more), (0, 1)))
            states[len(inputs) :, -1] = 1.0
            within = torch.from_numpy(targets).clamp(network.target_low, network.target_high)
            actions = np.pad(network.encode_targets(within).numpy(), ((0, more), (0, 0)))
            made.append((states[:-1], actions[:-1], states[1:]))
        return Transitions(*(np.concatenate(parts) for parts in zip(*made, strict=True)))


def read_demonstrations(
    roots: Sequence[Path], encode: Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]
) -> Demonstrations:
    """Read the expert's whole episodes from datasets.

    Episodes in which a learner drove at some step or a label is invalid are skipped, and so are
    those that failed.

    Args:
        roots: Folders of the datasets.
        encode: `Conversion.encode`, for actions (T, n) and states (T, n).

    Raises:
        NothingToLearnError: If no episode is left.
        NotFiniteError: If a number is not finite.
        ManipError: If a dataset cannot be read, see `joined_columns`.
    """
    names = [STATE, ENVIRONMENT_STATE, ACTION, EPISODE_INDEX, LABEL_VALID, ACTOR, SUCCESS]
    table = joined_columns(roots, names)
    for name, values in table.items():
        require_finite(f"column {name}", values)
    labelled = (table[LABEL_VALID].ravel() != 0) & (table[ACTOR].ravel() == Actor.EXPERT)
    solved = table[SUCCESS].ravel() != 0
    bounds = np.flatnonzero(np.diff(table[EPISODE_INDEX].ravel(), prepend=-1, append=-1))
    pieces = [slice(*pair) for pair in itertools.pairwise(bounds)]
    kept = [piece for piece in pieces if labelled[piece].all() and solved[piece].any()]
    if not kept:
        raise NothingToLearnError(
            f"none of the {len(pieces)} episodes in {', '.join(map(str, roots))} is the expert's"
            " and successful; record demonstrations with manip-il record"
        )
    inputs = np.concatenate([table[STATE], table[ENVIRONMENT_STATE]], axis=1).astype(np.float32)
    targets = [
        encode(table[ACTION][piece], table[STATE][piece]).astype(np.float32) for piece in kept
    ]
    hold = min(len(solved[piece]) - 1 - int(np.argmax(solved[piece])) for piece in kept)
    return Demonstrations(tuple(inputs[piece] for piece in kept), tuple(targets), hold)


class RobotEpisode:
    """An episode of our environment, which is simulated only.

    No state is stored and no expert is queried.
    """

    def __init__(self, config: EnvConfig, hold: int | None):
        """Make the environment.

        Args:
            config: The environment.
            hold: Control steps from success to the end; None if success does not end the episode.
        """
        self._env, self._hold = make_env(config), hold
        self._held = 0

    def start(self, seed: int) -> None:
        """Start the episode of a seed."""
        self._env.start(seed)
        self._held = 0

    def inputs(self) -> F32:
        """Return joint and environment state, not normalised, (n + k,)."""
        seen = self._env.observe()
        return np.concatenate([seen.state, seen.environment_state])

    def advance(self, action: F64) -> None:
        """Apply joint targets and the gripper's opening (n,)."""
        solved = self._env.step(action).solved
        if self._held or solved:
            self._held += 1

    @property
    def ended(self) -> bool:
        """Whether `hold` steps have passed since success."""
        return self._hold is not None and self._held > self._hold

    @property
    def solved(self) -> bool:
        """Whether the task has been solved at some step."""
        return self._held > 0


class Lockstep:
    """B episodes of equal length, run in lockstep.

    They never end, but continue in the absorbing state.

    Observations are (B, d + 2): inputs, the flag of the absorbing state, and the elapsed share of
    `horizon`.

    Attributes:
        simulated: Control steps of all episodes since `start`, without absorbing states.
        executed: Actions of every step since `start`, (B, n) each.
    """

    def __init__(
        self,
        episodes: Sequence[Any],
        network: MLPNetwork,
        horizon: int,
        conversion: Conversion | None = None,
    ):
        """Take the episodes.

        Args:
            episodes: Each a `RobotEpisode`, or an object with its methods.
            network: The policy, which turns normalised actions into raw targets.
            horizon: Control steps of every episode.
            conversion: Turns the policy's raw targets into actions, given the measured joints (the
                first inputs).
        """
        self.episodes = episodes
        self._network = network
        self.horizon = horizon
        self._conversion = conversion or Conversion()
        self.simulated = 0
        self.executed: list[F64] = []

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Whether each episode has succeeded so far, (B,)."""
        return np.array([one.solved for one in self.episodes])

    def start(self, seed: int) -> F32:
        """Start the episodes with the seeds `seed`, `seed` + 1, ....

        Return observations (B, d + 2).
        """
        for number, episode in enumerate(self.episodes):
            episode.start(seed + number)
        self._size = len(self.episodes[0].inputs())
        self.simulated, self.executed = 0, []
        return self._observe()

    def step(self, actions: F32) -> F32:
        """Step all episodes with normalised actions (B, n), converted in one call.

        Return observations (B, d + 2).
        """
        targets = self._network.decode_targets(torch.from_numpy(actions)).numpy()
        running = [row for row, episode in enumerate(self.episodes) if not episode.ended]
        executed = np.zeros(targets.shape)
        if running:
            measured = self._seen[running, : targets.shape[1]]
            executed[running] = self._conversion.decode(targets[running], measured)
        for row in running:
            self.episodes[row].advance(executed[row])
        self.simulated += len(running)
        self.executed.append(executed)
        return self._observe()

    def _observe(self) -> F32:
        """Observations (B, d + 2)."""
        elapsed = len(self.executed) / self.horizon
        rows = [
            np.append(np.zeros(self._size) if one.ended else one.inputs(), [one.ended, elapsed])
            for one in self.episodes
        ]
        self._seen = np.array(rows, np.float32)
        return self._seen
