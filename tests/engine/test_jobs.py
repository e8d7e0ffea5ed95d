"""A job and a seed are an episode, wherever and beside whomever it runs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from kept import written

from manip_il.data.schema import fitted_columns
from manip_il.engine.engine import Engine, default_workers
from manip_il.engine.environments import env_spec
from manip_il.engine.jobs import RolloutJob, run_job
from manip_il.errors import UsageError
from manip_il.mdp import Actor
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.env import EnvConfig
from manip_il.sim.events import STANDARD

SEEDS = stream_seeds("certificate", 6)
EXPERT = RolloutJob(EnvConfig("fetch"), "expert", hold=3)


def test_hold_ends_an_episode_so_many_steps_after_success():
    for episode in run_job(EXPERT, SEEDS):
        first = int(np.argmax(episode.columns["next.success"]))
        assert len(episode) == first + 1 + 3
        assert episode.success
        assert episode.columns["next.done"].ravel().tolist() == [False] * (len(episode) - 1) + [True]


def test_without_hold_an_episode_goes_to_the_horizon():
    job = replace(EXPERT, hold=None, env=EnvConfig("fetch", horizon=37))
    assert [len(episode) for episode in run_job(job, SEEDS[:2])] == [37, 37]


@pytest.mark.parametrize("job", [EXPERT, replace(EXPERT, driver="random"), replace(EXPERT, conditions=(STANDARD,))])
def test_an_episode_has_the_schemas_columns(job: RolloutJob):
    for episode in run_job(replace(job, round=4, beta=0.25), SEEDS[:2]):
        columns = fitted_columns(episode, env_spec(job.env))
        assert set(columns["seed"]) == {episode.seed}
        assert set(columns["round"]) == {4}
        assert set(columns["beta"]) == {0.25}


def test_an_episode_does_not_depend_on_the_others_of_its_job():
    for job in (replace(EXPERT, conditions=(STANDARD,)), replace(EXPERT, driver="random", env=EnvConfig(horizon=10))):
        together = written(run_job(job, SEEDS[:3]))
        assert written(run_job(job, SEEDS[1:2]))[SEEDS[1]] == together[SEEDS[1]]
        assert written(run_job(job, SEEDS[2::-1])) == together


def test_disturbances_are_drawn_from_the_seed():
    job = replace(EXPERT, conditions=(STANDARD,))
    seeds = SEEDS[:2]
    first, plain = written(run_job(job, seeds)), written(run_job(EXPERT, seeds))
    assert written(run_job(job, seeds)) == first
    assert all(first[seed]["executed_action"] != plain[seed]["executed_action"] for seed in seeds)
    assert written(run_job(replace(job, conditions=()), seeds)) == plain


def test_under_action_noise_the_actor_is_the_noisy_expert_and_labels_stay_the_experts():
    job = replace(EXPERT, conditions=(Condition("noisy", action_noise=(0.1, 0.1)),))
    for episode in run_job(job, SEEDS[:2]):
        columns = episode.columns
        assert set(columns["actor"].ravel()) == {Actor.NOISY_EXPERT}
        assert (columns["executed_action"] != columns["action"]).any(axis=1).all()
    for episode in run_job(replace(EXPERT, conditions=(Condition("knocked", knock=(0.05, 0.08)),)), SEEDS[:2]):
        columns = episode.columns
        assert set(columns["actor"].ravel()) == {Actor.EXPERT}
        np.testing.assert_array_equal(columns["executed_action"], columns["action"])


@pytest.mark.parametrize("driver", ["policy", "mixture"])
def test_a_learner_needs_its_folder(driver):
    with pytest.raises(UsageError, match=driver):
        RolloutJob(EnvConfig(), driver)


def test_labels_of_the_last_step_alone_tell_the_phase_at_the_end():
    job = replace(EXPERT, driver="random", label="last", env=EnvConfig("fetch", horizon=8))
    labelled = {e.seed: e for e in run_job(replace(job, label="per_state"), SEEDS[:2])}
    for episode in run_job(job, SEEDS[:2]):
        assert "action" not in episode.columns
        assert episode.columns["expert_phase"][-1] == labelled[episode.seed].columns["expert_phase"][-1]


def test_no_seeds_give_no_episodes():
    assert list(run_job(EXPERT, [])) == []
    assert list(Engine().run(EXPERT, [])) == []


def test_an_engine_wants_a_worker():
    with pytest.raises(UsageError, match="workers is 0"):
        Engine(0)
    assert default_workers() >= 1


@pytest.fixture(scope="module")
def two_processes() -> Iterator[Engine]:
    with Engine(2) as engine:
        yield engine


@pytest.mark.slow
@pytest.mark.parametrize("driver", ["policy", "mixture"])
def test_a_learned_policy_in_lockstep_and_in_two_processes_gives_the_same_bits(driver, checkpoint, two_processes):
    job = RolloutJob(EnvConfig(horizon=15), driver, policy=checkpoint, beta=0.5)
    together = written(run_job(job, SEEDS))
    assert len(together) == len(SEEDS)
    for seed in SEEDS[:2]:
        assert written(run_job(job, [seed])) == {seed: together[seed]}
    assert written(two_processes.run(job, SEEDS)) == together
