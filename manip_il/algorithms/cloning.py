"""Behaviour cloning: fit a policy to the expert's own demonstrations; every round adds demonstrations."""

import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.results import Result, Watch
from manip_il.algorithms.rounds import DATASET, JOURNALS, Rollouts, round_folder
from manip_il.algorithms.run import Run
from manip_il.collect.workers import Engine
from manip_il.data.atomic import new_folder


def cloning(run: Run, c: RunConfig) -> Iterator[Result]:
    """Yield each round: record demonstrations, fit to all of them, validate."""
    data: list[Rollouts] = []
    for i in range(c.rounds + 1):
        data.append(run.demonstrations(c.episodes_per_round if i else c.demonstrations, i))
        policy = run.fit(data)
        yield run.validate(policy)


def clone_with_labels(
    config: RunConfig, labels: int, other: Path, folder: Path, engine: Engine, watch: Watch
) -> tuple[Path, int]:
    """Fit a policy to `labels` labels from demonstrations alone, with a round's options: the baseline of a run.

    The demonstrations are those of round 0 of the run in `other`, and more from the same stream of seeds.
    Return the checkpoint and the number of labels.
    """
    run = Run(replace(config, label_budget=labels), folder, engine, watch)
    here, count = round_folder(folder, 0), config.demonstrations
    if not here.is_dir():
        with new_folder(here) as new:
            shutil.copytree(round_folder(other, 0) / JOURNALS, new / JOURNALS)
    while (made := run.demonstrations(count)).labels < labels:
        shutil.rmtree(here / DATASET)
        count = max(count + 1, math.ceil(count * labels / made.labels))
    return run.fit([made]).path, made.labels
