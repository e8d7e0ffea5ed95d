"""A job and a seed are an episode, wherever and beside whomever it runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kept import written

from manip_il import Expert
from manip_il.collect.drivers import ExpertDriver, NoisyExpertDriver, PolicyDriver, RandomDriver
from manip_il.collect.job import RolloutJob
from manip_il.collect.query import Query
from manip_il.data.episodes import parts
from manip_il.evaluation.suites import suite_conditions
from manip_il.mdp import Actor, Episode, State
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.events import STANDARD
from manip_il.worlds.ladder.world import LadderEnv, scene_of
from manip_il.worlds.table import env_spec, make_config

from ..learn.tiny_policies import write_checkpoint

SEEDS = stream_seeds("round/1", 4)
ENV = make_config(horizon=30)
EXPERT = RolloutJob(make_config("fetch"), hold=3)
NOISE = tuple(map(tuple, np.diag([1e-4] * 7 + [1e-6]).tolist()))
ONE, SELDOM, SAFETY = Query("one"), Query("probability", 0.2), Query("safety", 0.5)
JOBS = {
    "expert": {"driver": ExpertDriver(), "conditions": (STANDARD,), "round": 4},
    "noisy expert": {"driver": NoisyExpertDriver(NOISE)},
    "random": {"driver": RandomDriver()},
    "mixture": {"beta": 0.5},
    "policy of chunks": {
        "conditions": suite_conditions("all", make_config(), sees=False),
        "batch": 3,
    },
    "probability": {"query": Query("probability", 0.3)},
    "takeover": {"label": "takeover", "query": ONE},
    "branch": {"label": "branch", "query": ONE, "branch_steps": 4},
    "branches": {"label": "branch", "query": SELDOM, "branch_steps": 3},
}


@pytest.fixture
def job(checkpoint: Path) -> RolloutJob:
    return RolloutJob(ENV, PolicyDriver.of(checkpoint))


def run(job: RolloutJob, seeds=SEEDS) -> dict[int, Episode]:
    return {episode.seed: episode for episode in job.run(seeds)}


def labelled(episode: Episode) -> np.ndarray:
    return episode.columns["label_valid"].ravel() != 0


def is_the_experts(episode: Episode) -> None:
    """Every sound label is what the expert says of the frame's state, whoever drove."""
    expert = Expert(scene_of(ENV.robot, ENV.task))
    for i in np.flatnonzero(labelled(episode)):
        label = expert.label(State.from_vector(episode.columns["sim_state"][i]))
        np.testing.assert_array_equal(episode.columns["action"][i], label.action.astype(np.float32))
        assert episode.columns["expert_phase"][i] == label.phase


@pytest.mark.parametrize("name", JOBS)
def test_labels_are_the_experts_and_an_episode_depends_on_its_seed_alone(
    job: RolloutJob, name: str, tmp_path: Path
):
    changes = dict(JOBS[name])
    if name == "policy of chunks":  # whose memory could leak from one episode into another
        changes["driver"] = PolicyDriver.of(
            write_checkpoint(tmp_path / "act", "act", env_spec(ENV))
        )
    elif name == "mixture":
        changes = {"driver": replace(job.driver, **changes)}
    job = replace(job, **changes)
    together = run(job)
    for episode in together.values():
        assert labelled(episode).any()
        is_the_experts(episode)
        for part in parts(episode):
            wanted = {"seed": episode.seed, "round": job.round, "beta": job.driver.beta}
            assert {key: {*part.columns[key].flat} for key in wanted} == {
                key: {one} for key, one in wanted.items()
            }
    bits = written(together.values())
    assert len({columns["executed_action"] for columns in bits.values()}) == len(SEEDS)
    assert written(job.run(SEEDS[2:3])) == {SEEDS[2]: bits[SEEDS[2]]}
    assert written(replace(job, batch=1).run(SEEDS[::-1])) == bits


def test_one_query_an_episode_is_one_label(job: RolloutJob):
    queried = [labelled(episode) for episode in run(replace(job, query=ONE)).values()]
    assert [one.sum() for one in queried] == [1] * len(SEEDS)
    assert len({int(np.argmax(one)) for one in queried}) > 1


@pytest.mark.parametrize("query", [Query("probability", 0.3), SAFETY])
def test_a_rule_changes_nothing_but_where_there_are_labels(job: RolloutJob, query: Query):
    free = run(job)
    for episode in run(replace(job, query=query)).values():
        columns, alone, queried = episode.columns, free[episode.seed].columns, labelled(episode)
        np.testing.assert_array_equal(columns["executed_action"], alone["executed_action"])
        assert (queried <= labelled(free[episode.seed])).all()
        assert (columns["expert_phase"].ravel()[~queried] == 0).all()
        np.testing.assert_array_equal(
            columns["action"][~queried], columns["executed_action"][~queried]
        )


def test_a_takeover_is_the_learners_path_and_the_experts_recovery(job: RolloutJob):
    free = run(replace(job, label="last"))
    for episode in run(replace(job, label="takeover", query=ONE)).values():
        rolled_in, recovery = parts(episode)
        assert episode.success == rolled_in.success
        columns = recovery.columns
        assert not labelled(rolled_in).any()
        assert (rolled_in.columns["actor"] == Actor.LEARNER).all()
        alone = free[episode.seed].columns["executed_action"][: len(rolled_in)]
        np.testing.assert_array_equal(rolled_in.columns["executed_action"], alone)
        assert (columns["actor"] == Actor.EXPERT).all()
        np.testing.assert_array_equal(columns["executed_action"], columns["action"])
        assert len(recovery) >= ENV.horizon  # the expert has a horizon of its own


def test_what_an_expert_solves_is_not_the_learners_even_if_it_never_drove(job: RolloutJob):
    for episode in run(replace(job, label="takeover", query=Query("every"))).values():
        assert not episode.success
        assert parts(episode)[0].success


def test_branches_are_observed_with_the_noise_of_the_run(job: RolloutJob):
    noisy = replace(
        job, label="branch", query=SELDOM, conditions=(Condition("noise", joint_noise=0.05),)
    )
    for episode in run(noisy).values():
        _, *branches = parts(episode)
        states = [State.from_vector(one.columns["sim_state"][0]) for one in branches]
        env = LadderEnv(ENV)
        for one, state in zip(branches, states, strict=True):
            env.set_state(state)
            assert (
                0.01 < np.abs(one.columns["observation.state"][0] - env.observe().state).max() < 0.5
            )


def test_branches_begin_in_visited_states_and_the_learner_goes_on(job: RolloutJob):
    free = run(replace(job, label="last"))
    for episode in run(replace(job, label="branch", query=SELDOM, branch_steps=5)).values():
        path, *branches = parts(episode)
        assert not labelled(path).any()
        for key, column in free[episode.seed].columns.items():
            if key not in ("action", "label_valid", "expert_phase"):
                np.testing.assert_array_equal(path.columns[key], column)
        visited = {state.tobytes() for state in path.columns["sim_state"]}
        assert branches
        for branch in branches:
            assert len(branch) == 5
            assert branch.columns["sim_state"][0].tobytes() in visited
            assert (branch.columns["actor"] == Actor.EXPERT).all()
            np.testing.assert_array_equal(
                branch.columns["executed_action"], branch.columns["action"]
            )
        assert episode.success == path.success
