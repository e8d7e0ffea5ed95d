"""The benchmark on Pendulum and CartPole: its experts are good, its demonstrations never fall, and it runs."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def benchmark():
    sys.path.insert(0, str(FOLDER))
    try:
        yield importlib.import_module("adversarial")
    finally:
        sys.path.remove(str(FOLDER))


@pytest.mark.parametrize(("name", "expert", "random"), [("Pendulum-v1", -170, -900), ("CartPole-v1", 500, 60)])
def test_its_experts_are_far_better_than_random_actions(benchmark, name, expert, random):
    made, rng = benchmark.ENVIRONMENTS[name], np.random.default_rng(0)
    seeds = range(30)
    assert benchmark.play(name, made.expert, seeds, made.steps)[2].mean() >= expert
    assert benchmark.play(name, lambda inputs: made.random(inputs, rng), seeds, made.steps)[2].mean() <= random


@pytest.mark.parametrize("name", ["Pendulum-v1", "CartPole-v1"])
def test_no_demonstration_gets_to_the_absorbing_state(benchmark, name):
    shown = benchmark.demonstrations(name, benchmark.SETTINGS[name], 0)
    rows = shown.padded(shown.longest, lambda targets: targets)
    assert not rows.absorbing.any()
    assert len(rows) == 20 * 199, "the state after an episode's last step is not known"


def test_a_fall_of_the_pole_ends_the_episode_and_counts_as_no_success(benchmark):
    one = benchmark.CartPole()
    one.start(0)
    while not one.ended:
        one.advance(np.ones(1, np.float32))
    assert not one.solved
    assert one.total < 20


def test_the_same_training_seed_gives_the_same_policy(benchmark):
    settings = benchmark.replace(benchmark.SETTINGS["CartPole-v1"], **benchmark._QUICK)
    inputs = np.random.default_rng(0).normal(size=(20, 4)).astype(np.float32)
    first, again, other = (benchmark.trained("airl", "CartPole-v1", settings, seed)(inputs) for seed in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.slow
def test_it_prints_the_shares_of_both_algorithms_in_both_environments():
    words = [sys.executable, str(FOLDER / "adversarial.py"), "--quick"]
    out = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    found = re.findall(r"^(\w+), (\S+): interquartile mean -?\d", out, flags=re.MULTILINE)
    places = ("Pendulum-v1", "CartPole-v1", "together")
    assert found == [(algorithm, place) for algorithm in ("gail", "airl") for place in places]
