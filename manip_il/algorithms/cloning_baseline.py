"""The demo's baseline: cloning from demonstrations alone, with as many labels as DAgger used."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.rounds import fit_round, round_fit, round_folder
from manip_il.collect.job import RolloutJob
from manip_il.collect.record import MAX_TRIES, collect_successes, provenance, record
from manip_il.collect.workers import Engine
from manip_il.data.atomic import write_file
from manip_il.data.build import Recording
from manip_il.data.dataset import Dataset
from manip_il.data.journal import list_episodes
from manip_il.data.schema import LABEL_VALID
from manip_il.evaluation.runner import Progress
from manip_il.seeding import stream_seeds


def clone_with_labels(
    config: RunConfig, labels: int, run: Path, folder: Path, engine: Engine, progress: Progress
) -> tuple[Path, int]:
    """Fit a policy as every round's is fitted, to `labels` labels of demonstrations alone.

    The demonstrations are those of round 0 of the DAgger `run`, and the ones that follow in their stream of seeds.
    Returns the checkpoint and the number of labels.
    """
    if not (folder / "dataset").is_dir():
        _demonstrate(config, labels, round_folder(run, 0), folder, engine, progress)
    so_far = np.cumsum(Dataset.open(folder / "dataset").columns([LABEL_VALID])[LABEL_VALID])
    drawn = (so_far <= labels).astype(np.float64)
    progress.start("cloning with as many labels, fit", round_fit(config).total_steps)
    policy = fit_round(config, [folder / "dataset"], folder / "policy", on_log=progress.log, weights=drawn)
    progress.close()
    return policy, min(labels, int(so_far[-1]))


def _demonstrate(
    config: RunConfig, labels: int, round_0: Path, folder: Path, engine: Engine, progress: Progress
) -> None:
    """Record until the demonstrations hold `labels` frames; those of round 0 count."""
    journals = folder / "journals"
    journals.mkdir(parents=True, exist_ok=True)
    for path in list_episodes(round_0 / "journals"):
        write_file(journals / path.name, path.read_bytes())
    job = RolloutJob(config.env, hold=config.hold)
    count = config.demonstrations
    progress.start("cloning with as many labels, record", count)
    while True:
        seeds = stream_seeds("demonstrations", MAX_TRIES * count, config.seed)
        found = list(collect_successes(engine, job, seeds, count, journals, progress.episode))
        frames = sum(len(episode) for _, episode in found if episode.success)
        if frames >= labels:
            break
        count = max(count + 1, math.ceil(count * labels / frames))
        progress.start("cloning with as many labels, record", max(0, count - len(found)))
    name = f"local/{config.env.name}_demonstrations"
    record(found, journals, folder / "dataset", job, Recording(name, True, count, provenance(job)))
