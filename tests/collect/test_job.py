"""A job and a seed are an episode, wherever and beside whomever it runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kept import written

from manip_il.collect.drivers import ExpertDriver, NoisyExpertDriver, PolicyDriver, RandomDriver
from manip_il.collect.environments import env_spec
from manip_il.collect.expert import Expert
from manip_il.collect.job import RolloutJob
from manip_il.collect.query import Ensemble, Likelihood, One, Probability, Safety
from manip_il.collect.workers import Engine, default_workers
from manip_il.data.episodes import parts
from manip_il.data.schema import fitted_columns
from manip_il.errors import UsageError
from manip_il.evaluation.suites import suite_conditions
from manip_il.mdp import Actor, Episode, State
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.env import EnvConfig
from manip_il.sim.events import STANDARD
from manip_il.sim.scene import build_scene

from ..learn.tiny_policies import write_checkpoint

SEEDS = stream_seeds("round/1", 4)
ENV = EnvConfig(horizon=30)
EXPERT = RolloutJob(EnvConfig("fetch"), hold=3)
NOISE = tuple(map(tuple, np.diag([1e-4] * 7 + [1e-6]).tolist()))
ONE, SELDOM, SAFETY = One(), Probability(0.2), Safety(0.5)
JOBS = {
    "expert": {"driver": ExpertDriver(), "conditions": (STANDARD,), "round": 4},
    "noisy expert": {"driver": NoisyExpertDriver(NOISE)},
    "random": {"driver": RandomDriver()},
    "mixture": {"beta": 0.5},
    "policy of chunks": {"conditions": suite_conditions("all", EnvConfig(), sees=False), "batch": 3},
    "probability": {"query": Probability(0.3)},
    "takeover": {"label": "takeover", "query": ONE},
    "branch": {"label": "branch", "query": ONE, "branch_steps": 4},
    "branches": {"label": "branch", "query": SELDOM, "branch_steps": 3},
}


@pytest.fixture
def job(checkpoint: Path) -> RolloutJob:
    return RolloutJob(ENV, PolicyDriver((checkpoint,)))


def run(job: RolloutJob, seeds=SEEDS) -> dict[int, Episode]:
    return {episode.seed: episode for episode in job.run(seeds)}


def labelled(episode: Episode) -> np.ndarray:
    return episode.columns["label_valid"].ravel() != 0


def is_the_experts(episode: Episode) -> None:
    """Every sound label is what the expert says of the frame's state, whoever drove."""
    expert = Expert(build_scene(ENV.robot, ENV.task))
    for i in np.flatnonzero(labelled(episode)):
        label = expert.label(State.from_vector(episode.columns["sim_state"][i]))
        np.testing.assert_array_equal(episode.columns["action"][i], label.action.astype(np.float32))
        assert episode.columns["expert_phase"][i] == label.phase


@pytest.mark.parametrize("name", JOBS)
def test_labels_are_the_experts_and_an_episode_depends_on_its_seed_alone(job: RolloutJob, name: str, tmp_path: Path):
    changes = dict(JOBS[name])
    if name == "policy of chunks":  # whose memory could leak from one episode into another
        changes["driver"] = PolicyDriver((write_checkpoint(tmp_path / "act", "act", env_spec(ENV)),))
    elif name == "mixture":
        changes = {"driver": replace(job.driver, **changes)}
    job = replace(job, **changes)
    together = run(job)
    for episode in together.values():
        assert labelled(episode).any()
        is_the_experts(episode)
        for part in parts(episode):
            columns = fitted_columns(part, env_spec(ENV))
            assert [set(columns[key]) for key in ("seed", "round", "beta")] == [
                {episode.seed},
                {job.round},
                {job.driver.beta},
            ]
    bits = written(together.values())
    assert len({columns["executed_action"] for columns in bits.values()}) == len(SEEDS)
    assert written(job.run(SEEDS[2:3])) == {SEEDS[2]: bits[SEEDS[2]]}
    assert written(replace(job, batch=1).run(SEEDS[::-1])) == bits


@pytest.mark.slow
@pytest.mark.parametrize("beta", [0.0, 0.5])
def test_two_processes_give_the_same_bits(beta, job, two_processes):
    job = replace(job, driver=replace(job.driver, beta=beta))
    assert written(two_processes.run(job, SEEDS)) == written(job.run(SEEDS))


def test_hold_ends_an_episode_so_many_steps_after_success():
    for episode in run(EXPERT).values():
        assert len(episode) == int(np.argmax(episode.columns["next.success"])) + 1 + 3
        assert episode.success
        assert episode.columns["next.done"].ravel().tolist() == [False] * (len(episode) - 1) + [True]
    whole = replace(EXPERT, hold=None, env=EnvConfig("fetch", horizon=37))
    assert [len(episode) for episode in whole.run(SEEDS[:2])] == [37, 37]


def test_a_disturbed_episode_is_another_one():
    disturbed, plain = (written(one.run(SEEDS[:2])) for one in (replace(EXPERT, conditions=(STANDARD,)), EXPERT))
    assert all(disturbed[seed]["executed_action"] != plain[seed]["executed_action"] for seed in SEEDS[:2])


@pytest.mark.parametrize(
    ("condition", "actor", "off"),
    [
        (Condition("noisy", action_noise=(0.1, 0.1)), Actor.NOISY_EXPERT, True),
        (Condition("knocked", knock=(0.05, 0.08)), Actor.EXPERT, False),
    ],
)
def test_under_action_noise_the_actor_is_the_noisy_expert(condition, actor: Actor, off: bool):
    for episode in replace(EXPERT, conditions=(condition,)).run(SEEDS[:2]):
        assert set(episode.columns["actor"].ravel()) == {actor}
        assert ((episode.columns["executed_action"] != episode.columns["action"]).any(axis=1) == off).all()


def test_a_noisy_expert_has_its_noise():
    for episode in run(RolloutJob(EnvConfig("panda"), NoisyExpertDriver(NOISE), hold=3)).values():
        assert (episode.columns["actor"] == Actor.NOISY_EXPERT).all()
        off = np.subtract(episode.columns["executed_action"], episode.columns["action"])
        assert off.std(axis=0)[:7] == pytest.approx(0.01, rel=0.4)


def test_labels_of_the_last_step_alone_tell_the_phase_at_the_end():
    job = replace(EXPERT, driver=RandomDriver(), env=EnvConfig("fetch", horizon=8))
    every = run(job, SEEDS[:2])
    for episode in replace(job, label="last").run(SEEDS[:2]):
        assert "action" not in episode.columns
        assert episode.columns["expert_phase"][-1] == every[episode.seed].columns["expert_phase"][-1]


def test_where_the_expert_was_not_queried_the_label_is_not_to_be_learnt_from(job: RolloutJob):
    for episode in run(replace(job, query=Probability(0.3))).values():
        queried, columns = labelled(episode), episode.columns
        assert 0 < queried.sum() < len(episode)
        assert (columns["expert_phase"].ravel()[~queried] == 0).all()
        np.testing.assert_array_equal(columns["action"][~queried], columns["executed_action"][~queried])


def test_one_query_an_episode_is_one_label(job: RolloutJob):
    queried = [labelled(episode) for episode in run(replace(job, query=ONE)).values()]
    assert [one.sum() for one in queried] == [1] * len(SEEDS)
    assert len({int(np.argmax(one)) for one in queried}) > 1


def test_gates_do_not_change_what_the_learner_does(job: RolloutJob):
    free = run(job)
    for episode in run(replace(job, query=SAFETY)).values():
        alone = free[episode.seed].columns
        np.testing.assert_array_equal(episode.columns["executed_action"], alone["executed_action"])
        gap = np.abs(np.subtract(alone["action"], alone["executed_action"])) / [*[0.25] * 7, 0.08]
        assert (labelled(episode) <= labelled(free[episode.seed])).all()
        assert gap[labelled(episode)].max(axis=1).min() > 0.1


def test_a_takeover_is_the_learners_path_and_the_experts_recovery(job: RolloutJob):
    free = run(replace(job, label="last"))
    for episode in run(replace(job, label="takeover", query=ONE)).values():
        rolled_in, recovery = parts(episode)
        columns = recovery.columns
        assert not labelled(rolled_in).any()
        assert (rolled_in.columns["actor"] == Actor.LEARNER).all()
        alone = free[episode.seed].columns["executed_action"][: len(rolled_in)]
        np.testing.assert_array_equal(rolled_in.columns["executed_action"], alone)
        assert (columns["actor"] == Actor.EXPERT).all()
        np.testing.assert_array_equal(columns["executed_action"], columns["action"])
        assert len(recovery) >= ENV.horizon  # the expert has a horizon of its own


def test_an_expert_that_is_never_wanted_takes_nothing_over(job: RolloutJob):
    free = run(replace(job, label="last"))
    for episode in run(replace(job, label="takeover", query=Safety(1e6))).values():
        assert (len(parts(episode)), len(episode)) == (1, ENV.horizon)
        assert not labelled(episode).any()
        alone = free[episode.seed].columns["executed_action"]
        np.testing.assert_array_equal(episode.columns["executed_action"], alone)


def test_an_expert_that_takes_over_solves_what_it_took_over(job: RolloutJob):
    episodes = run(replace(job, env=EnvConfig(), label="takeover", query=ONE, hold=3))
    assert all(episode.success for episode in episodes.values())


def test_a_takeover_in_a_disturbed_world_is_cut_where_the_expert_took_over(job: RolloutJob):
    for episode in run(replace(job, label="takeover", query=ONE, conditions=(STANDARD,))).values():
        rolled_in, recovery = parts(episode)
        assert (rolled_in.columns["actor"] == Actor.LEARNER).all()
        assert (recovery.columns["actor"] == Actor.NOISY_EXPERT).all()
        is_the_experts(recovery)


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
            np.testing.assert_array_equal(branch.columns["executed_action"], branch.columns["action"])
        assert episode.success == path.success


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"driver": ExpertDriver(), "label": "takeover"},
            "takes over from a policy; this .* driven by 'expert'",
        ),
        ({"query": Ensemble(0.1)}, "needs other policies to disagree with"),
        ({"query": Likelihood(0.0)}, "needs a policy with a likelihood"),
    ],
)
def test_what_a_job_lacks_is_said_before_it_runs(job: RolloutJob, changes, words: str):
    with pytest.raises(UsageError, match=words):
        next(replace(job, **changes).run(SEEDS))


def test_no_seeds_give_no_episodes_and_an_engine_wants_a_worker():
    assert list(EXPERT.run([])) == list(Engine().run(EXPERT, [])) == []
    with pytest.raises(UsageError, match="workers is 0"):
        Engine(0)
    assert default_workers() >= 1
