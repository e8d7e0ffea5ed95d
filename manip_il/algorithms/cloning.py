"""Behaviour cloning: a policy is fitted to the expert's own demonstrations, of which every round adds some."""

import math
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.imitation import DATASET, JOURNALS, ImitationRun
from manip_il.algorithms.rounds import Rollouts, fit_round, round_fit, round_folder
from manip_il.algorithms.run import Result, Watch
from manip_il.collect.workers import Engine
from manip_il.data.atomic import new_folder
from manip_il.data.dataset import joined_columns
from manip_il.data.schema import LABEL_VALID


def cloning(run: ImitationRun, c: RunConfig) -> Iterator[Result]:
    """Yield every round: demonstrate, fit to all demonstrations, validate."""
    data: list[Rollouts] = []
    for i in range(c.rounds + 1):
        data.append(run.demonstrations(c.episodes(i), i))
        policy = run.fit(data)
        yield run.validate(policy)


def clone_with_labels(
    config: RunConfig, labels: int, other: Path, folder: Path, engine: Engine, watch: Watch
) -> tuple[Path, int]:
    """Fit a policy, as every round's is fitted, to `labels` labels of demonstrations alone: the baseline of a run.

    The demonstrations are those of round 0 of the run in `other`, and the ones that follow in their stream of seeds.
    Returns the checkpoint and the number of labels.
    """
    run, here, count = ImitationRun(config, folder, engine, watch), round_folder(folder, 0), config.demonstrations
    if not here.is_dir():
        with new_folder(here) as new:
            shutil.copytree(round_folder(other, 0) / JOURNALS, new / JOURNALS)
    while (made := run.demonstrations(count)).labels < labels:
        shutil.rmtree(here / DATASET)
        count = max(count + 1, math.ceil(count * labels / made.labels))
    roots = [here / DATASET]
    so_far = np.cumsum(joined_columns(roots, [LABEL_VALID])[LABEL_VALID])
    watch.on_stage("fit", 0, round_fit(config).total_steps)
    drawn = (so_far <= labels).astype(np.float64)
    policy = fit_round(config, roots, folder / "policy", on_log=watch.on_log, weights=drawn)
    return policy, min(labels, int(so_far[-1]))
