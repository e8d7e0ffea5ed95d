"""Runs of GAIL, AIRL and of a given reward, very small: what lies on disk, bit-equal each time."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.algorithms.results import Result, best_validation, validations
from manip_il.chapter.config import DiscriminatorConfig, LearningConfig, PPOConfig
from manip_il.chapter.learning import LearningRun, ppo
from manip_il.chapter.reward import LearnedReward
from manip_il.cli.main import main
from manip_il.collect.workers import Engine
from manip_il.errors import FolderExistsError
from manip_il.learn.checkpoint import find_policy
from manip_il.learn.policy import LearnedPolicy
from manip_il.worlds.table import env_spec, make_config

from ..collect.clones import clone
from ..damage import digests

pytestmark = pytest.mark.slow  # every test here waits for whole runs

ENV = make_config("fetch", "reach")


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> LearningConfig:
    """Options of a run on three demonstrations, of about three iterations."""
    root = tmp_path_factory.mktemp("demos") / "reach"
    words = [
        "--robot.type=fetch",
        "--task.type=reach",
        "--dataset.num_episodes=3",
        "--workers=1",
        "--quiet",
    ]
    assert main(["record", *words, f"--dataset.root={root}"]) == 0
    return LearningConfig(
        method="gail",
        env=ENV,
        datasets=(root,),
        steps=300,
        episodes=4,
        ppo=PPOConfig(minibatches=2, epochs=2),
        discriminator=DiscriminatorConfig(width=16, steps=3, batch_size=16),
        validation_every=200,
        validation_episodes=1,
    )


@pytest.fixture(scope="module")
def cloned(tmp_path_factory) -> Path:
    return clone(ENV, 3, tmp_path_factory.mktemp("cloned"), steps=30, width=16)


def run(config: LearningConfig, folder: Path, count: int | None = None) -> list[Result]:
    """Run an algorithm for at most so many iterations beyond what it begins with."""
    begun = int(config.start is not None)
    results = LearningRun(config, folder, Engine()).results()
    return list(itertools.islice(results, begun, None if count is None else begun + count))


@pytest.mark.parametrize("method", ["gail", "airl"])
def test_the_same_options_give_the_same_bytes_in_a_folder_of_their_own(method, config, tmp_path):
    config = replace(config, method=method)
    once, again = (run(config, tmp_path / name) for name in ("once", "again"))
    assert len(once) >= 2
    assert [one.metrics for one in once] == [one.metrics for one in again]
    for place in ("best", "validation"):
        assert digests(tmp_path / "once" / place) == digests(tmp_path / "again" / place)
    with pytest.raises(FolderExistsError):
        run(config, tmp_path / "once")


def test_a_run_leaves_policies_that_act_and_the_best_of_them(config, tmp_path):
    results = run(config, tmp_path)
    found = validations(tmp_path)
    assert list(found) == [one.number for one in results if one.validated is not None]
    assert results[-1].validated is not None
    best = tmp_path / "best" / "pretrained_model"
    assert (results[best_validation(found) - 1].number) == best_validation(found)
    policy = LearnedPolicy.load(best)
    assert policy.checkpoint.space == "ee_delta"
    k = policy.checkpoint.numbers["observation.environment_state"]
    assert policy.act(np.zeros((1, 8), np.float32), np.zeros((1, k), np.float32)).shape == (1, 8)
    assert results[-1].steps >= config.steps
    assert not list(tmp_path.rglob("*.p[kt]*"))


def test_until_the_warm_up_is_over_a_clone_acts_as_it_did(config, cloned, tmp_path):
    config = replace(config, start=cloned, warmup=2, validation_every=1)
    second, third = (
        run(config, tmp_path / "warm", count=2)[-1],
        run(config, tmp_path / "moved", count=3)[-1],
    )
    rng = np.random.default_rng(0)
    k = LearnedPolicy.load(cloned).checkpoint.numbers["observation.environment_state"]
    seen = rng.normal(size=(5, 8)).astype(np.float32), rng.normal(size=(5, k)).astype(np.float32)
    before, warm, moved = (
        LearnedPolicy.load(one).act(*seen) for one in (cloned, second.policy, third.policy)
    )
    assert np.array_equal(before, warm)
    assert not np.array_equal(before, moved)
    assert list(validations(tmp_path / "warm")) == [0, 1, 2], "0 is the clone itself"


def test_a_policy_learns_from_the_reward_that_airl_kept(config, cloned, tmp_path):
    discriminator = replace(config.discriminator, state_only=True)
    airl = replace(config, method="airl", steps=100, discriminator=discriminator)
    run(airl, tmp_path / "airl")
    reward = LearnedReward.load(find_policy(tmp_path / "airl" / "reward"))
    spec = env_spec(ENV)
    reward.check_fits("the environment", spec)
    rows = np.random.default_rng(0).normal(size=(50, 16 + len(spec.environment_state_names)))
    inputs = rows.astype(np.float32)
    others = inputs.copy()
    others[:, -8:] = 0
    assert np.array_equal(reward(inputs), reward(others)), "it is a function of the state"
    assert np.ptp(reward(inputs)) > 0
    words = ["--steps=40", "--episodes=4", "--episode_steps=10", "--validation_episodes=1"]
    found = [f"--reward={tmp_path / 'airl' / 'reward'}", f"--init={cloned}"]
    assert main(["rl", "ppo", *words, *found, f"--output_dir={tmp_path / 'ppo'}", "--quiet"]) == 0


def test_a_reward_that_is_given_sees_steps_as_datasets_have_them(config, cloned, tmp_path):
    seen = []

    def reward(rows):
        seen.append(rows.shape)
        assert np.isfinite(rows).all()
        return -np.abs(rows[:, -8:] - rows[:, :8]).sum(1).astype(np.float32)

    config = replace(config, datasets=(), start=cloned, episode_steps=10, steps=60, warmup=0)
    results = list(ppo(LearningRun(config, tmp_path, Engine()), config, reward))
    assert [one.steps for one in results] == [0, 40, 80]
    spec = env_spec(ENV)
    assert seen == [(40, 16 + len(spec.environment_state_names))] * 2
