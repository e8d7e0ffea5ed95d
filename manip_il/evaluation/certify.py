"""Measure the expert's recoverability: rollouts perturbed once, beside the same ones undisturbed.

Expert and simulator are deterministic, so the undisturbed run of a seed gives the cost-to-go of every state on it, and
the same run with one wrong action gives the cost of that action.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.environments import env_fingerprint
from manip_il.collect.job import RolloutJob
from manip_il.collect.query import Query
from manip_il.collect.workers import Engine
from manip_il.data import schema
from manip_il.errors import ManipError, UsageError
from manip_il.evaluation.certificate import Case, Certificate, Group, Row
from manip_il.mdp import F32, F64, Actor, Episode
from manip_il.seeding import rng_for, stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.events import Perturbation, kinds_for
from manip_il.tasks.config import EnvConfig
from manip_il.tasks.table import get_task

_LOG = logging.getLogger(__name__)
NOISE = 0.1  # standard deviation of the actions' noise, as a share of their range
Progress = Callable[[Episode], None]


def certify(
    engine: Engine,
    env: EnvConfig,
    cases: int,
    seed: int = 0,
    policy: Path | None = None,
    on_episode: Progress | None = None,
    *,
    trust: bool = False,
) -> Certificate:
    """Measure the expert on `env` with `cases` episodes of each kind, on the seeds of the stream `certificate`.

    A perturbation happens at a step drawn evenly from those that the undisturbed run takes until the task is solved;
    the expert then has a whole horizon. policy: the expert goes on from states that this one visits, too; trust: see
    `LearnedPolicy.load`. on_episode: sees every episode as it ends.
    """
    if cases < 1:
        raise UsageError(f"cases is {cases}; expected at least 1")
    run = _Run(engine, env, stream_seeds("certificate", cases, seed), on_episode)
    rows = [run.starts()]
    rows += [run.perturbed(kind) for kind in kinds_for(get_task(env.task))]
    rows.append(run.noisy())
    if policy is not None:
        rows.append(run.taken_over(policy, trust))
    if engine.given_up:
        _LOG.warning("left out, as each repeatedly killed its worker: seeds %s", engine.given_up)
    settings = {"cases": cases, "seed": seed}
    settings |= {name: getattr(env, name) for name in ("horizon", "control_hz", "tolerance", "success_steps")}
    name = None if policy is None else str(policy)
    return Certificate(env.robot, env.task, name, env_fingerprint(env), settings, tuple(rows))


def count_episodes(env: EnvConfig, cases: int, policy: Path | None = None) -> int:
    """Return how many episodes `certify` runs at most."""
    return cases * (2 + len(kinds_for(get_task(env.task))) + (policy is not None))


class _Moment(NamedTuple):
    """A step of the undisturbed run, how many more that took, its state (m,) and the action (n,) executed there."""

    step: int
    steps: int
    state: F64
    action: F32


class _Run:
    """The rows of one certificate; `starts` comes first, as the others need its runs."""

    def __init__(self, engine: Engine, env: EnvConfig, seeds: Sequence[int], on_episode: Progress | None):
        self._engine, self._env, self._seeds, self._on_episode = engine, env, seeds, on_episode
        self._kinds = kinds_for(get_task(env.task))
        self._moments: dict[str, dict[int, _Moment]] = {kind: {} for kind in self._kinds}  # kind -> seed -> moment

    def starts(self) -> Row:
        """Episodes as they begin."""
        cases: list[Case] = []
        for episode in self._episodes(RolloutJob(self._env, hold=0), self._seeds):
            case = self._case(episode, 0)
            cases.append(case)
            if case.steps is not None:
                for kind, moments in self._moments.items():
                    step = draw_moment(case.seed, kind, case.steps)
                    moments[case.seed] = _Moment(step, case.steps - step, *_state_and_action(episode, step))
        if not any(case.steps for case in cases):
            raise ManipError(
                f"the expert solved none of {len(self._seeds)} undisturbed episodes within {self._env.horizon} steps, "
                "so there is nothing to perturb; give it a longer --env.horizon"
            )
        return self._row("start", "start", "undisturbed, from the start", cases)

    def noisy(self) -> Row:
        """From where episodes begin, with noise on every action."""
        job = RolloutJob(self._env, hold=0, conditions=(Condition("noise", action_noise=(NOISE, NOISE)),))
        cases = [self._case(episode, 0) for episode in self._episodes(job, self._seeds)]
        return self._row("start", "noise", f"{NOISE:.0%} noise on every action", cases)

    def perturbed(self, kind: str) -> Row:
        """Episodes perturbed once."""
        moments = self._moments[kind]
        steps = {seed: moment.step for seed, moment in moments.items()}
        longer = replace(self._env, horizon=max(steps.values()) + self._env.horizon)
        job = RolloutJob(longer, hold=0, conditions=(Perturbation(kind, steps),))
        cases: list[Case] = []
        for episode in self._episodes(job, list(moments)):
            moment = moments[episode.seed]
            undisturbed = (moment.state, moment.action)
            if not all(map(np.array_equal, _state_and_action(episode, moment.step), undisturbed)):
                cases.append(self._case(episode, moment.step, moment.steps))
        known = self._kinds[kind]
        return self._row("action" if known.wrong else "state", kind, known.words, cases)

    def taken_over(self, policy: Path, trust: bool) -> Row:
        """States that a learner visits: at a drawn step of a horizon the expert takes over."""
        driver = PolicyDriver((policy,), trust=trust)
        job = RolloutJob(self._env, driver, hold=0, label="takeover", query=Query("one"))
        cases: list[Case] = []
        for episode in self._episodes(job, self._seeds):
            taken = np.flatnonzero(episode.columns[schema.ACTOR].ravel() == Actor.EXPERT)
            if taken.size:  # else the learner solved it before
                cases.append(self._case(episode, int(taken[0])))
        return self._row("learner", "learner", "states that the policy visited", cases)

    def _episodes(self, job: RolloutJob, seeds: Sequence[int]) -> Iterator[Episode]:
        for episode in self._engine.run(job, seeds):
            yield episode
            if self._on_episode is not None:
                self._on_episode(episode)

    def _case(self, episode: Episode, moment: int, undisturbed: int | None = None) -> Case:
        solved = np.flatnonzero(episode.columns[schema.SUCCESS].ravel()[moment : moment + self._env.horizon])
        steps = int(solved[0]) + 1 if solved.size else None
        labelled = bool(episode.columns[schema.LABEL_VALID][-1, 0])
        return Case(episode.seed, moment, steps, undisturbed, labelled)

    def _row(self, group: Group, name: str, words: str, cases: list[Case]) -> Row:
        in_order = tuple(sorted(cases, key=lambda case: case.seed))
        return Row(group, name, words, in_order, self._env.horizon, len(self._seeds) - len(cases))


def draw_moment(seed: int, kind: str, steps: int) -> int:
    """Return one of the `steps` steps of an undisturbed run, for one kind of perturbation."""
    return int(rng_for(seed, f"moment of {kind}").integers(steps))


def _state_and_action(episode: Episode, step: int) -> tuple[F64, F32]:
    return episode.columns[schema.SIM_STATE][step].copy(), episode.columns[schema.EXECUTED_ACTION][step].copy()
