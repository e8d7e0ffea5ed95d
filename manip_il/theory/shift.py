"""Distribution shift on an arm, measured for every round of a DAgger run.

How often a round's policy errs in the expert's states and in its own, step by step; how far its own states lie from the
data that it was fitted on; what it costs more than the expert, beside what Theorem 8.2 allows for as many errors.
Costs are control steps until the task is solved, the horizon where it is not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.environments import env_actions, env_spec
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data import schema
from manip_il.data.dataset import joined_columns
from manip_il.errors import ManipError
from manip_il.evaluation.intervals import Proportion
from manip_il.learn.policy import LearnedPolicy
from manip_il.mdp import Episode
from manip_il.seeding import rng_for, stream_seeds
from manip_il.tasks.config import EnvConfig

F64 = NDArray[np.float64]
EPISODES = 50  # of the expert and of every round's policy
WRONG = 0.25  # of the largest step: an action that is farther off the label, in any joint, is wrong
FEWEST = 5  # episodes that still run at a step, for its share of wrong actions to be shown
MOST_STATES = 4_000  # of a kind, that are compared
_HAND = ("ee.x", "ee.y", "ee.z")
_OBSERVED = (schema.STATE, schema.ENVIRONMENT_STATE)
OnEpisode = Callable[[Episode], None]


class RoundData(NamedTuple):
    """A round on disk: its number, its policy's `pretrained_model` folder, and the datasets that was fitted on."""

    round: int
    policy: Path
    datasets: tuple[Path, ...]


class Visited(NamedTuple):
    """States of some episodes: what a policy observes (N, d), and the hand (N, 3) [m]."""

    observed: F64
    hand: F64


@dataclass(frozen=True)
class Errors:
    """Wrong actions. by_step: share of the running episodes that err at a step, while `FEWEST` run.

    rate: of all states; per_episode: wrong actions in an episode, on average.
    """

    by_step: tuple[float, ...]
    rate: float
    per_episode: float


@dataclass(frozen=True)
class RoundShift:
    """One round's policy. on_expert: None for a policy on pictures; on_own: in the states that it visits itself.

    distance: of its states from the data, median to the nearest; of the expert's, in new episodes, it is 1. cost, gap:
    its own, and above the expert's; bound: what Theorem 8.2 allows that to be, u times its wrong actions an episode
    [control steps]. data, hand: where the hand was in the data and in its rollouts, (N, 3) [m].
    """

    round: int
    success: Proportion
    on_expert: Errors | None
    on_own: Errors
    distance: float
    cost: float
    gap: float
    bound: float
    data: F64
    hand: F64

    @property
    def name(self) -> str:
        """Name of the policy."""
        return "cloning (round 0)" if self.round == 0 else f"round {self.round}"

    def to_json(self) -> dict[str, Any]:
        """Return all numbers but the places."""
        return {
            "round": self.round,
            "success": self.success.rate,
            "interval": list(self.success.interval),
            "on_expert": None if self.on_expert is None else vars(self.on_expert),
            "on_own": vars(self.on_own),
            **{name: getattr(self, name) for name in ("distance", "cost", "gap", "bound")},
        }


@dataclass(frozen=True)
class Shift:
    """A whole run. expert_cost: [control steps]; u: the most that one wrong action was seen to cost [control steps]."""

    env: EnvConfig
    expert_cost: float
    u: int
    rounds: tuple[RoundShift, ...]

    def to_json(self) -> dict[str, Any]:
        """Return all numbers but the places."""
        return {
            "robot": self.env.robot,
            "task": self.env.task,
            "horizon": self.env.horizon,
            "expert_cost": self.expert_cost,
            "u": self.u,
            "rounds": [one.to_json() for one in self.rounds],
        }


def find_rounds(run: Path) -> list[RoundData]:
    """Return the rounds of a run that have a policy. Raises `ManipError` where there is none."""
    found, datasets = list[RoundData](), list[Path]()
    for folder in sorted(run.glob("round_[0-9][0-9][0-9]")):
        if (folder / "dataset" / "meta" / "info.json").is_file():
            datasets.append(folder / "dataset")
        policy = folder / "policy" / "checkpoints" / "last" / "pretrained_model"
        if (policy / "config.json").is_file() and datasets:
            found.append(RoundData(int(folder.name[-3:]), policy, tuple(datasets)))
    if not found:
        raise ManipError(f"{run} has no round with a policy; expected the folder of a run of manip-il dagger")
    return found


def measure_shift(
    engine: Engine,
    env: EnvConfig,
    rounds: Sequence[RoundData],
    u: int,
    episodes: int = EPISODES,
    on_episode: OnEpisode = lambda _: None,
) -> Shift:
    """Run the expert and every round's policy on the same seeds, the expert asked in every state.

    u: of the expert on `env`, see `certify`.
    """
    names = env_spec(env).environment_state_names
    seeds = stream_seeds("theory", episodes)
    expert = _run(engine, RolloutJob(env, hold=0), seeds, on_episode)
    fresh, expert_cost, found = _visited(expert, names), _cost(expert, env.horizon), list[RoundShift]()
    for one in rounds:
        learner = _run(engine, RolloutJob(env, PolicyDriver((one.policy,)), hold=0), seeds, on_episode)
        states, data, cost = _visited(learner, names), _stored(one, names), _cost(learner, env.horizon)
        on_own = _errors([episode.columns[schema.EXECUTED_ACTION] for episode in learner], learner, env)
        found.append(
            RoundShift(
                round=one.round,
                success=Proportion.of([episode.success for episode in learner]),
                on_expert=_errors_on(one.policy, expert, env),
                on_own=on_own,
                distance=relative_distance(states.observed, data.observed, fresh.observed),
                cost=cost,
                gap=cost - expert_cost,
                bound=u * on_own.per_episode,
                data=data.hand,
                hand=states.hand,
            )
        )
    return Shift(env, expert_cost, u, tuple(found))


def _run(engine: Engine, job: RolloutJob, seeds: Sequence[int], on_episode: OnEpisode) -> list[Episode]:
    found = list[Episode]()
    for episode in engine.run(job, seeds):
        found.append(episode.without_pictures())
        on_episode(episode)
    return sorted(found, key=lambda episode: episode.seed)


def _cost(episodes: Sequence[Episode], horizon: int) -> float:
    return float(np.mean([len(episode) if episode.success else horizon for episode in episodes]))


def _visited(episodes: Sequence[Episode], names: Sequence[str]) -> Visited:
    return _states({key: np.concatenate([one.columns[key] for one in episodes]) for key in _OBSERVED}, names)


def _stored(round_: RoundData, names: Sequence[str]) -> Visited:
    """States of the data that a round's policy was fitted on, but those after success, which rollouts here end at."""
    table = joined_columns(round_.datasets, [*_OBSERVED, schema.SUCCESS])
    rows = np.flatnonzero(~table[schema.SUCCESS].ravel().astype(np.bool_))
    if len(rows) > MOST_STATES:
        rows = np.sort(rng_for(round_.round, "states of the data").choice(rows, MOST_STATES, replace=False))
    return _states({key: table[key][rows] for key in _OBSERVED}, names)


def _states(columns: Mapping[str, NDArray[Any]], names: Sequence[str]) -> Visited:
    observed = np.concatenate([columns[key] for key in _OBSERVED], axis=1).astype(np.float64)
    hand = columns[schema.ENVIRONMENT_STATE][:, [names.index(name) for name in _HAND]].astype(np.float64)
    return Visited(observed, hand)


def relative_distance(states: F64, data: F64, fresh: F64) -> float:
    """Return the median distance of states (N, d) to their nearest in the data (M, d), 1 for the expert's new ones.

    fresh: those, (F, d). In standard deviations of the data's columns.
    """
    scale = np.maximum(data.std(axis=0), 1e-6)
    own, usual = (np.median(cdist(rows / scale, data / scale).min(axis=1)) for rows in (states, fresh))
    return float(own / usual) if usual > 0 else float("inf")


def _errors_on(policy: Path, episodes: Sequence[Episode], env: EnvConfig) -> Errors | None:
    """Errors of a policy's actions in the states of these episodes, which somebody else drove."""
    learner = LearnedPolicy.load(policy)
    if learner.cameras:
        return None
    actions: list[list[NDArray[Any]]] = [[] for _ in episodes]
    learner.reset(range(len(episodes)))
    for t in range(max(map(len, episodes))):
        running = [i for i, episode in enumerate(episodes) if t < len(episode)]
        seen = [np.stack([episodes[i].columns[key][t] for i in running]) for key in _OBSERVED]
        for i, action in zip(running, learner.act(seen[0], seen[1], {}, running), strict=True):
            actions[i].append(action)
    return _errors([np.stack(one) for one in actions], episodes, env)


def _errors(actions: Sequence[NDArray[Any]], episodes: Sequence[Episode], env: EnvConfig) -> Errors:
    """Errors of actions (T, n), one array an episode, where the expert's label is sound."""
    scale, longest = env_actions(env).scale, max(map(len, episodes))
    sizes = np.full((len(episodes), longest), np.nan)
    for row, mine, one in zip(sizes, actions, episodes, strict=True):
        off = (np.abs(mine - one.columns[schema.ACTION]) / scale).max(axis=1)
        row[: len(one)] = np.where(one.columns[schema.LABEL_VALID].ravel().astype(np.bool_), off, np.nan)
    known = np.isfinite(sizes)
    wrong, running = (known & (sizes > WRONG)).sum(axis=0), known.sum(axis=0)
    shown = int((running >= min(FEWEST, len(episodes))).argmin()) or longest
    return Errors(
        tuple((wrong / running.clip(min=1))[:shown].tolist()),
        float(wrong.sum() / running.sum()),
        float(wrong.sum() / len(episodes)),
    )
