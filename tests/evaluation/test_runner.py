"""An evaluation's outcomes belong to their seeds, and it stops where it says it does."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import pytest

from manip_il.collect.drivers import PolicyDriver, RandomDriver
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.evaluation import measuring
from manip_il.evaluation.measuring import measure
from manip_il.evaluation.results import EpisodeResult, EvalResult
from manip_il.evaluation.suites import suite_conditions
from manip_il.progress import Progress
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import NOMINAL, turn_of
from manip_il.worlds.table import env_spec, make_config

from ..collect.clones import clone
from ..learn.tiny_policies import write_checkpoint

SEEDS = stream_seeds("certificate", 12)
ENV = make_config("fetch", horizon=12)
ALL = suite_conditions("all", make_config(), sees=False)


@pytest.fixture(scope="module")
def act(tmp_path_factory):
    """A policy of chunks, whose memory could leak from one episode into another."""
    return write_checkpoint(tmp_path_factory.mktemp("act"), "act", env_spec(ENV))


@pytest.fixture(scope="module")
def mlp(tmp_path_factory):
    """A policy of one call for all episodes, fitted a little so that its actions differ from
    state to state.
    """
    return clone(
        make_config("fetch"),
        3,
        tmp_path_factory.mktemp("policy"),
        steps=60,
        width=64,
        batch_size=64,
    )


def evaluate(engine: Engine, job: RolloutJob, seeds: Sequence[int], name: str, **how) -> EvalResult:
    return measure(engine, job, seeds, name, Progress(), **how)


def job_of(policy, **changes) -> RolloutJob:
    return RolloutJob(ENV, PolicyDriver.of(policy), label="last", **changes)


def actions(engine: Engine, job: RolloutJob, seeds: Sequence[int]) -> dict[int, bytes]:
    return {one.seed: one.columns["executed_action"].tobytes() for one in engine.run(job, seeds)}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["act", "mlp"])
def test_actions_depend_on_no_batch_no_worker_and_no_order(kind, request):
    policy = request.getfixturevalue(kind)
    job = replace(job_of(policy, conditions=ALL), env=replace(ENV, horizon=20))
    seeds = stream_seeds("test", 28)
    expected = actions(Engine(1), replace(job, batch=1), seeds)
    assert len({*expected.values()}) > 20
    with Engine(2) as two:
        for batch in (8, 25):
            for engine in (Engine(1), two):
                assert actions(engine, replace(job, batch=batch), seeds) == expected
    assert actions(Engine(1), job, seeds[::-1]) == expected


def test_an_episode_of_a_suite_is_that_of_its_condition_alone(act):
    together = actions(Engine(1), job_of(act, conditions=ALL), SEEDS)
    nominal = actions(Engine(1), job_of(act), SEEDS)
    same = [seed for seed in SEEDS if together[seed] == nominal[seed]]
    assert same == [seed for seed in SEEDS if turn_of(ALL, seed) == NOMINAL]
    assert len(same) == 3


class Coins(Engine):
    """Its episodes are their seeds, in reverse; `asked` is what was to be run."""

    def __init__(self) -> None:
        super().__init__(1)
        self.asked: list[list[int]] = []

    def run(self, job, seeds, keep=None):  # pyright: ignore[reportIncompatibleMethodOverride]
        self.asked.append(list(seeds))
        return (SimpleNamespace(seed=seed) for seed in reversed(seeds))


@pytest.fixture
def coins(monkeypatch):
    """Engines whose episodes come out as a list says."""

    def make(outcomes: list[bool]) -> Coins:
        monkeypatch.setattr(
            measuring, "episode_result", lambda job, one: result(one.seed, outcomes[one.seed])
        )
        return Coins()

    return make


COIN = RolloutJob(ENV, RandomDriver(), label="last")


def result(seed: int, success: bool) -> EpisodeResult:
    return EpisodeResult(seed, success, success, 10, float(success))


def test_until_width_stops_at_the_first_look_that_is_narrow_enough(coins):
    engine = coins([seed % 50 != 7 for seed in range(10_000)])
    found = evaluate(engine, COIN, range(10_000), "coin", until_width=0.05)
    low, high = found.success.interval
    assert high - low <= 0.05
    assert len(found.episodes) % measuring.CHECK_EVERY == 0
    shorter = replace(found, episodes=found.episodes[: -measuring.CHECK_EVERY])
    assert shorter.success.interval[1] - shorter.success.interval[0] > 0.05
    assert [episode.seed for episode in found.episodes] == list(range(len(found.episodes)))
    assert max(map(max, engine.asked)) == len(found.episodes) - 1  # nothing beyond it was run


def test_what_is_done_is_not_run_again_and_changes_nothing(coins, tmp_path):
    outcomes = [seed % 9 != 0 for seed in range(1_000)]
    for width in (None, 0.1):
        whole = evaluate(coins(outcomes), COIN, range(1_000), "coin", until_width=width)
        engine, folder = coins(outcomes), tmp_path / str(width)
        evaluate(coins(outcomes), COIN, range(0, 1_000, 3), "coin", folder=folder)
        resumed = evaluate(engine, COIN, range(1_000), "coin", folder=folder, until_width=width)
        assert resumed == whole
        assert not {seed for asked in engine.asked for seed in asked} & set(range(0, 1_000, 3))
