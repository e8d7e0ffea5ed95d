"""What becomes of the states in which a learner's rollout asks the expert."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.data.episodes import parts
from manip_il.data.schema import fitted_columns
from manip_il.engine.drivers import QueryRule
from manip_il.engine.environments import env_spec
from manip_il.engine.jobs import RolloutJob, run_job
from manip_il.errors import UsageError
from manip_il.expert import Expert
from manip_il.mdp import Actor, Episode, State
from manip_il.seeding import stream_seeds
from manip_il.sim.env import EnvConfig
from manip_il.sim.events import STANDARD
from manip_il.sim.scene import build_scene

SEEDS = stream_seeds("round/1", 4)
ENV = EnvConfig(horizon=30)


@pytest.fixture
def job(checkpoint: Path) -> RolloutJob:
    return RolloutJob(ENV, "policy", policy=checkpoint)


def run(job: RolloutJob, seeds=SEEDS) -> dict[int, Episode]:
    return {episode.seed: episode for episode in run_job(job, seeds)}


def content(episode: Episode) -> dict[str, bytes]:
    return {key: column.tobytes() for key, column in episode.columns.items()}


def labelled(episode: Episode) -> np.ndarray:
    return episode.columns["label_valid"].ravel() != 0


def is_the_experts(episode: Episode) -> None:
    """Every sound label is what the expert says of the frame's state, whoever drove."""
    expert = Expert(build_scene(ENV.robot, ENV.task))
    for i in np.flatnonzero(labelled(episode)):
        label = expert.label(State.from_vector(episode.columns["sim_state"][i]))
        np.testing.assert_array_equal(episode.columns["action"][i], label.action.astype(np.float32))


@pytest.mark.parametrize(
    "changes",
    [
        {"query": QueryRule("probability", 0.3)},
        {"label": "takeover", "query": QueryRule("one")},
        {"label": "branch", "query": QueryRule("one"), "branch_steps": 4},
        {"label": "branch", "query": QueryRule("probability", 0.2), "branch_steps": 3},
    ],
)
def test_labels_are_the_experts_and_an_episode_depends_on_its_seed_alone(job: RolloutJob, changes):
    job = replace(job, **changes)
    together = run(job)
    for episode in together.values():
        is_the_experts(episode)
        for part in parts(episode):
            fitted_columns(part, env_spec(ENV))
    assert content(run(job, SEEDS[2:3])[SEEDS[2]]) == content(together[SEEDS[2]])


def test_where_nobody_asked_the_label_is_not_to_be_learnt_from(job: RolloutJob):
    for episode in run(replace(job, query=QueryRule("probability", 0.3))).values():
        asked = labelled(episode)
        assert 0 < asked.sum() < len(episode)
        columns = episode.columns
        assert (columns["expert_phase"].ravel()[~asked] == 0).all()
        np.testing.assert_array_equal(columns["action"][~asked], columns["executed_action"][~asked])


def test_one_question_an_episode_is_one_label(job: RolloutJob):
    asked = [labelled(episode) for episode in run(replace(job, query=QueryRule("one"))).values()]
    assert [one.sum() for one in asked] == [1] * len(SEEDS)
    assert len({int(np.argmax(one)) for one in asked}) > 1


def test_gates_do_not_change_what_the_learner_does(job: RolloutJob):
    free = run(job)
    for episode in run(replace(job, query=QueryRule("safety", 0.5))).values():
        alone = free[episode.seed].columns
        np.testing.assert_array_equal(episode.columns["executed_action"], alone["executed_action"])
        gap = np.abs(np.subtract(alone["action"], alone["executed_action"])) / [*[0.25] * 7, 0.08]
        assert (labelled(episode) <= labelled(free[episode.seed])).all()
        assert gap[labelled(episode)].max(axis=1).min() > 0.1


def test_a_takeover_is_the_learners_path_and_the_experts_recovery(job: RolloutJob):
    free = run(replace(job, label="last"))
    for episode in run(replace(job, label="takeover", query=QueryRule("one"))).values():
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
    for episode in run(replace(job, label="takeover", query=QueryRule("safety", 1e6))).values():
        assert len(parts(episode)) == 1
        assert len(episode) == ENV.horizon
        assert not labelled(episode).any()
        alone = free[episode.seed].columns["executed_action"]
        np.testing.assert_array_equal(episode.columns["executed_action"], alone)


def test_an_expert_that_takes_over_solves_what_it_took_over(job: RolloutJob):
    episodes = run(replace(job, env=EnvConfig(), label="takeover", query=QueryRule("one"), hold=3))
    assert all(episode.success for episode in episodes.values())


def test_a_takeover_in_a_disturbed_world_is_cut_where_the_expert_took_over(job: RolloutJob):
    noisy = replace(job, label="takeover", query=QueryRule("one"), conditions=(STANDARD,))
    for episode in run(noisy).values():
        rolled_in, recovery = parts(episode)
        assert (rolled_in.columns["actor"] == Actor.LEARNER).all()
        assert (recovery.columns["actor"] == Actor.NOISY_EXPERT).all()
        is_the_experts(recovery)


def test_branches_begin_in_visited_states_and_the_learner_goes_on(job: RolloutJob):
    free = run(replace(job, label="last"))
    for episode in run(replace(job, label="branch", query=QueryRule("probability", 0.2), branch_steps=5)).values():
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


def test_what_a_job_lacks_is_said_before_it_runs(checkpoint: Path):
    with pytest.raises(UsageError, match="needs other policies to disagree with"):
        RolloutJob(ENV, "policy", policy=checkpoint, query=QueryRule("ensemble", 0.1))
    with pytest.raises(UsageError, match="takes over from a policy; this rollout is driven by 'mixture'"):
        RolloutJob(ENV, "mixture", policy=checkpoint, label="takeover")
    with pytest.raises(UsageError, match="needs its noise"):
        RolloutJob(ENV, "noisy_expert")
    with pytest.raises(UsageError, match="needs a policy with a likelihood"):
        run(RolloutJob(ENV, "policy", policy=checkpoint, query=QueryRule("likelihood", 0.0)))


def test_a_noisy_expert_is_labelled_by_the_clean_one():
    noise = tuple(map(tuple, np.diag([1e-4] * 7 + [1e-6]).tolist()))
    for episode in run(RolloutJob(EnvConfig("panda"), "noisy_expert", noise=noise, hold=3)).values():
        columns = episode.columns
        is_the_experts(episode)
        assert (columns["actor"] == Actor.NOISY_EXPERT).all()
        off = np.subtract(columns["executed_action"], columns["action"])
        assert off.std(axis=0)[:7] == pytest.approx(0.01, rel=0.4)
