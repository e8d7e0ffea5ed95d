"""An algorithm is one file: here two that are in no table, on a run that resumes by itself."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.results import Result
from manip_il.algorithms.rounds import Rollouts, mixture
from manip_il.algorithms.run import Run
from manip_il.collect.workers import Engine
from manip_il.data.dataset import Dataset
from manip_il.learn.fit_config import FitConfig
from manip_il.mdp import Episode
from manip_il.progress import Progress
from manip_il.worlds.table import make_config

from ..conftest import watching
from ..damage import check_same_data

pytestmark = pytest.mark.slow

CONFIG = RunConfig(
    env=make_config("fetch", "reach", horizon=40),
    demonstrations=2,
    rounds=2,
    episodes_per_round=2,
    fit=FitConfig({"width": 16}, steps=20, batch_size=32),
    validation_episodes=1,
)


def expert_only(run: Run, c: RunConfig) -> Iterator[Result]:
    """Fit to the expert's demonstrations, once."""
    policy = run.fit([run.demonstrations(c.demonstrations)])
    yield run.validate(policy)


def halves(run: Run, c: RunConfig) -> Iterator[Result]:
    """Let expert and learner drive half of the steps each, and learn from the latest rollouts
    alone.
    """
    data: Rollouts = run.demonstrations(c.demonstrations)
    for i in range(1, c.rounds + 1):
        policy = run.fit([data])
        yield run.validate(policy)
        data = run.rollouts(i, mixture(policy, 0.5))
    yield run.validate(run.fit([data]))


def follow(algorithm, folder: Path, watch: Progress | None = None) -> list[Result]:
    run = Run(CONFIG, folder, Engine(), watch)
    return list(run.follow(algorithm(run, CONFIG)))


@pytest.mark.parametrize(("algorithm", "betas"), [(expert_only, [1.0]), (halves, [1.0, 0.5, 0.5])])
def test_a_new_algorithm_goes_on_where_it_was_stopped_to_the_same_bytes(algorithm, betas, tmp_path):
    whole, rounds = follow(algorithm, tmp_path / "whole"), len(betas)
    assert [result.number for result in whole] == list(range(rounds))
    assert [result.metrics["beta"] for result in whole] == betas
    assert [result.episodes for result in whole] == [2, 4, 6][:rounds]
    assert [result.labels for result in whole] == sorted({result.labels for result in whole})
    assert Dataset.open(tmp_path / "whole/dataset").info.episodes == 2 * rounds
    count = 0

    def stop(episode: Episode) -> None:
        nonlocal count
        count += 1
        if count == 3 * rounds:  # in the last round's validation
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        follow(algorithm, tmp_path / "again", watching(episode=stop))
    again = follow(algorithm, tmp_path / "again")
    assert [result.validation for result in again] == [result.validation for result in whole]
    check_same_data(tmp_path / "again", tmp_path / "whole")
