"""Measure the expert's recoverability: rollouts with one perturbation, compared with the same
rollouts undisturbed.

The reward is 1 in every control step after success. V(s) is what the expert gets from state s on,
and Q(s, a) the same after action a, so V(s) - Q(s, a), the number of control steps by which success
is later, is what action a costs. Expert and simulator are deterministic, so the undisturbed run of
a seed gives V of every state in it, and the same run with one wrong action gives Q.

Ross, Gordon & Bagnell (2011, Theorem 2.2) bound imitation by the largest such cost, u: a learner
that errs in a share e of the H steps of its own episodes gets at most u H e less than the expert,
so its loss is linear in H if mistakes can be undone, not quadratic. Rajaraman et al. (2021) call
this mu-recoverability. The largest cost among sampled actions, as here, is a lower bound of u.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from manip_il.collect.drivers import DisturbedDriver
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data import schema
from manip_il.errors import ManipError
from manip_il.evaluation.intervals import CONFIDENCE, Proportion
from manip_il.evaluation.report import INTERVAL, Table
from manip_il.mdp import Episode
from manip_il.seeding import rng_for, stream_seeds
from manip_il.sim.events import Perturbation, kinds_for
from manip_il.tasks.table import get_task
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import env_fingerprint, env_spec

FILE_NAME = "certificate.json"
# other worlds than ours: kind -> number of random actions in a row
_RANDOM = {"random": 1, "lost": 20}
Group = Literal["start", "state", "action"]


class Case(NamedTuple):
    """One episode of a certificate.

    Attributes:
        seed: The episode's seed.
        moment: The control step from which the expert is judged.
        steps: Control steps from the moment until the task is solved; None if it is not solved
            within the horizon.
        undisturbed: The same without the perturbation, if known.
    """

    seed: int
    moment: int
    steps: int | None
    undisturbed: int | None = None


@dataclass(frozen=True)
class Row:
    """The cases of one kind of perturbation.

    Attributes:
        group: What is perturbed.
        kind: Short name of the kind.
        words: Full name of the kind.
        cases: The cases, by seed.
        horizon: Control steps within which the expert must solve the task.
        left_out: Number of episodes without a case, because the undisturbed run failed, or the
            perturbation could not be placed or changed nothing.
    """

    group: Group
    kind: str
    words: str
    cases: tuple[Case, ...]
    horizon: int
    left_out: int = 0

    @property
    def success(self) -> Proportion | None:
        """Share of cases solved within a horizon from their moment; None if there are no cases."""
        return (
            Proportion.of([case.steps is not None for case in self.cases]) if self.cases else None
        )

    @property
    def gaps(self) -> list[int]:
        """V(s) - Q(s, a), the cost of each wrong action [control steps].

        The whole horizon if the expert did not recover.
        """
        known = [case for case in self.cases if case.undisturbed is not None]
        return [
            self.horizon if case.steps is None else case.steps - (case.undisturbed or 0)
            for case in known
        ]

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; a case is [seed, moment, steps, undisturbed]."""
        found = {"group": self.group, "kind": self.kind, "words": self.words}
        found |= {"n": len(self.cases), "left_out": self.left_out}
        found |= (
            self.success.to_json() if self.success else {"success_rate": None, "interval": None}
        )
        return found | {"cases": [list(case) for case in self.cases]}


@dataclass(frozen=True)
class Certificate:
    """Recoverability of the expert on one robot and task.

    Attributes:
        robot: Name of the robot.
        task: Name of the task.
        fingerprint: The environment's fingerprint.
        settings: `cases` (per kind), `seed`, `horizon` [control steps], `control_hz`, `tolerance`
            [m] and `success_steps`.
        rows: One row per kind of perturbation.
    """

    robot: str
    task: str
    fingerprint: Mapping[str, Any]
    settings: Mapping[str, Any]
    rows: tuple[Row, ...]

    def of(self, group: Group) -> tuple[Row, ...]:
        """Return the rows of a group."""
        return tuple(row for row in self.rows if row.group == group)

    @property
    def mu(self) -> int | None:
        """The largest gap over all wrong actions [control steps]: the empirical u of Ross et al.
        (2011).
        """
        return max((gap for row in self.of("action") for gap in row.gaps), default=None)

    def to_json(self) -> dict[str, Any]:
        """Return the contents of `certificate.json`."""
        rows = [row.to_json() for row in self.rows]
        return vars(self) | {"confidence": CONFIDENCE, "mu": self.mu, "rows": rows}

    def table(self) -> Table:
        """Return one row per kind of perturbation: how often the expert recovers, and what a
        wrong action costs.
        """
        rows: list[tuple[str, ...]] = []
        for row in self.rows:
            gaps = row.gaps if row.group == "action" else []
            costs = (f"{np.mean(gaps):.1f}", str(max(gaps))) if gaps else ("", "")
            rows.append(
                (row.words, str(row.success or ""), *costs, str(len(row.cases)), str(row.left_out))
            )
        head = ("the expert continues from", f"solved {INTERVAL}", "mean cost", "largest cost")
        return Table((*head, "cases", "left out"), tuple(rows))


def count_episodes(env: EnvConfig, cases: int) -> int:
    """Return the largest number of episodes that `certify` runs."""
    return cases * (1 + len(_kinds(env)))


class _Kind(NamedTuple):
    """A kind of perturbation: what it perturbs, its name, and its job for moments by seed."""

    group: Group
    words: str
    job: Callable[[EnvConfig, Mapping[int, int]], RolloutJob]


def _kinds(env: EnvConfig) -> dict[str, _Kind]:
    """Return the kinds of perturbation of an environment: those of `manip_il.sim.events`, or, in
    other worlds, random actions.
    """
    if "perturbed" not in env_spec(env).can:
        return {
            kind: _Kind(
                "action" if steps == 1 else "state",
                "random action" if steps == 1 else f"{steps} random actions",
                partial(_lost, steps),
            )
            for kind, steps in _RANDOM.items()
        }
    return {
        kind: _Kind("action" if known.wrong else "state", known.words, partial(_perturbed, kind))
        for kind, known in kinds_for(get_task(env.task)).items()
    }


def _lost(steps: int, env: EnvConfig, moments: Mapping[int, int]) -> RolloutJob:
    return RolloutJob(env, DisturbedDriver(moments=moments, steps=steps), hold=0)


def _perturbed(kind: str, env: EnvConfig, moments: Mapping[int, int]) -> RolloutJob:
    return RolloutJob(env, hold=0, conditions=(Perturbation(kind, moments),))


def certify(
    engine: Engine,
    env: EnvConfig,
    cases: int,
    seed: int = 0,
    on_episode: Callable[[Episode], object] = lambda _: None,
) -> Certificate:
    """Measure how well the expert recovers from perturbations in one environment.

    The step of a perturbation is drawn uniformly from those that the undisturbed run takes until
    the task is solved; from that step on, the expert has a whole horizon to solve it.

    Args:
        engine: What runs the episodes.
        env: The environment.
        cases: Number of episodes per kind of perturbation.
        seed: Selects the episodes' seeds, which are from the stream `certificate`.
        on_episode: Called with every episode as it ends.

    Returns:
        The certificate, with one row per kind of perturbation and one for undisturbed episodes.

    Raises:
        ManipError: if the expert solves none of the undisturbed episodes.
    """
    seeds = stream_seeds("certificate", cases, seed)
    rows: list[Row] = []

    def rollouts(job: RolloutJob, seeds: Sequence[int] = seeds) -> Iterator[Episode]:
        for episode in engine.run(job, seeds):
            yield episode
            on_episode(episode)

    def add(group: Group, kind: str, words: str, cases: Iterable[Case]) -> None:
        in_order = tuple(sorted(cases))
        rows.append(Row(group, kind, words, in_order, env.horizon, len(seeds) - len(in_order)))

    plain = {episode.seed: episode for episode in rollouts(RolloutJob(env, hold=0))}
    starts = [_case(episode, 0, env.horizon) for episode in plain.values()]
    add("start", "start", "undisturbed, from the start", starts)
    solved = {case.seed: case.steps for case in starts if case.steps is not None}
    if not solved:
        raise ManipError(
            f"the expert solved none of {len(seeds)} undisturbed episodes within {env.horizon}"
            " steps, so there is nothing to perturb; give it a longer --env.horizon"
        )
    for kind, known in _kinds(env).items():
        moments = {seed: draw_moment(seed, kind, steps) for seed, steps in solved.items()}
        longer = replace(env, horizon=max(moments.values()) + env.horizon)
        job = known.job(longer, moments)
        found = [
            _case(episode, moment, env.horizon, solved[episode.seed] - moment)
            for episode in rollouts(job, list(moments))
            if _differ(episode, plain[episode.seed], moment := moments[episode.seed])
        ]
        add(known.group, kind, known.words, found)
    names = ("horizon", "control_hz", "tolerance", "success_steps")
    settings = {"cases": cases, "seed": seed} | {name: getattr(env, name) for name in names}
    spec = env_spec(env)
    return Certificate(spec.robot, spec.task, env_fingerprint(env), settings, tuple(rows))


def draw_moment(seed: int, kind: str, steps: int) -> int:
    """Draw the control step at which an undisturbed run is perturbed, uniformly.

    Args:
        seed: The episode's seed.
        kind: The kind of perturbation; each kind has its own random stream.
        steps: Control steps until the undisturbed run solves the task.

    Returns:
        The index of the step, from 0 to `steps` - 1.
    """
    return int(rng_for(seed, f"moment of {kind}").integers(steps))


def _case(episode: Episode, moment: int, horizon: int, undisturbed: int | None = None) -> Case:
    solved = np.flatnonzero(episode.columns[schema.SUCCESS].ravel()[moment : moment + horizon])
    return Case(episode.seed, moment, int(solved[0]) + 1 if solved.size else None, undisturbed)


def _differ(one: Episode, other: Episode, step: int) -> bool:
    """Return whether the state or the executed action of a step differs between two episodes."""
    names = (schema.SIM_STATE, schema.EXECUTED_ACTION)
    return not all(
        np.array_equal(one.columns[name][step], other.columns[name][step]) for name in names
    )
