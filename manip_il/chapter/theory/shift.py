"""Distribution shift on an arm, measured for every round of a DAgger run.

For each round's policy: how often it errs in the expert's states and in its own, and how much less
its value is than the expert's, compared with the bounds of Theorems 8.1 and 8.2. The reward is 1 in
every control step after success, so a value V is the horizon H less the cost: the control steps
until the task is solved, or H if it is not.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.chapter.theory.bounds import cloning_bound, dagger_bound
from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data import schema
from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.errors import ManipError
from manip_il.evaluation.intervals import Proportion
from manip_il.learn.policy import LearnedPolicy, actions_along
from manip_il.mdp import F64, Episode
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import described_env, env_spec

EPISODES = 50  # episodes of the expert and of each round's policy
# an action is wrong if any joint is off the label by more than this share of its largest step
WRONG = 0.25
_COLUMNS = (
    schema.STATE,
    schema.ENVIRONMENT_STATE,
    schema.ACTION,
    schema.EXECUTED_ACTION,
    schema.LABEL_VALID,
)
Columns = dict[str, NDArray[Any]]
OnEpisode = Callable[[Episode], None]


# number, `pretrained_model` folder
RoundData = tuple[int, Path]


@dataclass(frozen=True)
class RoundShift:
    """One round's policy.

    Attributes:
        round: Number of the round.
        success: Success rate of the policy.
        shares: Shares of the visited states in which the policy is wrong, in the expert's episodes
            (None for a policy on pictures) and in its own.
        errors: The same as `classification_error`, whose divisor is the horizon.
        cost: Mean cost [control steps].
        gap: The expert's value minus the policy's [control steps].
        bounds: Upper bounds on the gap [control steps]: H² eps with the first of `errors`, and u H
            eps with the second.
    """

    round: int
    success: Proportion
    shares: tuple[float | None, float]
    errors: tuple[float | None, float]
    cost: float
    gap: float
    bounds: tuple[float | None, float]

    @property
    def name(self) -> str:
        """Name of the policy."""
        return "cloning (round 0)" if self.round == 0 else f"round {self.round}"

    def to_json(self) -> dict[str, Any]:
        """Return all numbers."""
        return vars(self) | {"success": self.success.rate, "interval": list(self.success.interval)}


@dataclass(frozen=True)
class Shift:
    """The distribution shift of a run's rounds.

    Attributes:
        env: The environment.
        expert_cost: The expert's mean cost [control steps].
        u: Largest cost seen of one wrong action [control steps].
        rounds: The rounds.
    """

    env: EnvConfig
    expert_cost: float
    u: int
    rounds: tuple[RoundShift, ...]

    def to_json(self) -> dict[str, Any]:
        """Return all numbers."""
        return {
            "robot": env_spec(self.env).robot,
            "task": env_spec(self.env).task,
            "horizon": self.env.horizon,
            "expert_cost": self.expert_cost,
            "u": self.u,
            "rounds": [one.to_json() for one in self.rounds],
        }


def find_rounds(run: Path) -> list[RoundData]:
    """Return the rounds of a run that have a policy.

    Raises `ManipError` if there is none.
    """
    found = list[RoundData]()
    for folder in sorted(run.glob("round_[0-9][0-9][0-9]")):
        for policy in folder.glob("policy/checkpoints/last/pretrained_model"):
            found.append((int(folder.name[-3:]), policy))
    if not found:
        raise ManipError(
            f"{run} has no round with a policy; expected the folder of a run of manip-il dagger"
        )
    return found


def measure_shift(
    engine: Engine,
    env: EnvConfig,
    rounds: Sequence[RoundData],
    u: int,
    episodes: int = EPISODES,
    on_episode: OnEpisode = lambda _: None,
    conditions: tuple[Condition, ...] = (),
) -> Shift:
    """Run the expert and every round's policy on the same seeds.

    The expert is queried in every state.

    Args:
        engine: Runs the episodes.
        env: The environment.
        rounds: The rounds of a run, see `find_rounds`.
        u: The expert's recoverability on `env` [control steps], see `certify`.
        episodes: Episodes of each driver.
        on_episode: Called with every finished episode.
        conditions: The run's variations of the world.

    Returns:
        The rounds' errors in the expert's states and in their own, with gaps and bounds.
    """
    seeds, scale = stream_seeds("theory", episodes), described_env(env).actions.scale
    found = list[RoundShift]()
    plain = RolloutJob(env, hold=0, conditions=conditions)
    expert, expert_cost, _ = _run(engine, plain, seeds, on_episode)
    for number, path in rounds:
        own, cost, success = _run(
            engine, replace(plain, driver=PolicyDriver.of(path)), seeds, on_episode
        )
        policy = LearnedPolicy.load(path)
        wrong = is_wrong(own[schema.EXECUTED_ACTION], own, scale)
        share, error = float(wrong.mean()), classification_error(wrong, episodes, env.horizon)
        on_expert = cloning_error = None
        if not policy.cameras:
            wrong = is_wrong(_actions_on(policy, expert), expert, scale)
            on_expert = float(wrong.mean())
            cloning_error = classification_error(wrong, episodes, env.horizon)
        found.append(
            RoundShift(
                round=number,
                success=success,
                shares=(on_expert, share),
                errors=(cloning_error, error),
                cost=cost,
                gap=cost - expert_cost,
                bounds=(
                    None if cloning_error is None else cloning_bound(env.horizon, cloning_error),
                    dagger_bound(env.horizon, error, u),
                ),
            )
        )
    return Shift(env, expert_cost, u, tuple(found))


def _run(
    engine: Engine, job: RolloutJob, seeds: Sequence[int], on_episode: OnEpisode
) -> tuple[Columns, float, Proportion]:
    """Columns of all episodes in the order of their seeds, their mean cost, and their success
    rate.
    """
    found = list[Episode]()
    for episode in engine.run(job, seeds):
        found.append(episode.without_pictures())
        on_episode(episode)
    found.sort(key=lambda episode: episode.seed)
    table = {key: np.concatenate([one.columns[key] for one in found]) for key in _COLUMNS}
    table[EPISODE_INDEX] = np.repeat(np.arange(len(found)), [len(one) for one in found])
    cost = float(
        np.mean([len(episode) if episode.success else job.env.horizon for episode in found])
    )
    return table, cost, Proportion.of([episode.success for episode in found])


def _actions_on(policy: LearnedPolicy, table: Columns) -> F64:
    """Actions of a policy in the states of another driver's episodes, (N, n)."""
    found = np.empty(table[schema.ACTION].shape)
    for rows, actions in actions_along(policy, table):
        found[rows] = actions
    return found


def is_wrong(actions: NDArray[Any], table: Columns, scale: F64) -> NDArray[np.bool_]:
    """Return whether actions are wrong, one entry for each frame with a valid label.

    Args:
        actions: The actions, (N, n).
        table: The frames' columns, of which the labels and their validity are read.
        scale: Largest step of each joint, and the gripper's opening, (n,).
    """
    off = (np.abs(actions - table[schema.ACTION]) / scale).max(axis=1) > WRONG
    return off[table[schema.LABEL_VALID].ravel() != 0]


def classification_error(wrong: NDArray[np.bool_], episodes: int, horizon: int) -> float:
    """Return eps of Eq. 8.5: the mean number of wrong actions per episode over the horizon H.

    Episodes may end before H steps; the steps that they do not take count as right.

    Args:
        wrong: Whether the action of each step of all episodes is wrong.
        episodes: Number of episodes.
        horizon: The horizon H [control steps].
    """
    return float(wrong.sum() / (episodes * horizon))
