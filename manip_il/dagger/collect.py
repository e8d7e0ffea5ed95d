"""Episodes on disk: run what is missing, keep each one the moment it ends."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from manip_il.data.build import Builder, Recording
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.journal import (
    JournalKeep,
    clean_temporary,
    episode_path,
    list_episodes,
    list_seeds,
    read_header,
    read_journal,
    set_aside_damaged,
)
from manip_il.data.lerobot_io import DatasetInfo
from manip_il.data.schema import check_same_spec
from manip_il.engine.describe import env_fingerprint, env_spec
from manip_il.engine.engine import Engine
from manip_il.engine.jobs import RolloutJob
from manip_il.errors import ManipError, MismatchError
from manip_il.mdp import Episode

_LOG = logging.getLogger(__name__)
OnEpisode = Callable[[Episode], None]
MAX_TRIES = 3  # times the asked number of episodes, before an expert that mostly fails is given up


def collect(
    engine: Engine, job: RolloutJob, seeds: Sequence[int], journals: Path, on_episode: OnEpisode | None = None
) -> Iterator[Path]:
    """Run the seeds that have no journal in `journals` yet; each finished episode becomes one file at once.

    Yields the journals in the order of the seeds, as soon as all before one are there. A seed that kills its worker
    again and again has none: a warning names it. on_episode is called once an episode is on disk; what it raises
    ends the run, and what is on disk stays.
    """
    there = set(list_seeds(journals))
    missing = [seed for seed in seeds if seed not in there]
    keep = JournalKeep(journals, env_spec(job.env, job.cameras), env_fingerprint(job.env, job.cameras))
    waiting = iter(seeds)
    seed = next(waiting, None)
    for episode in engine.run(job, missing, keep):
        there.add(episode.seed)
        if on_episode is not None:
            on_episode(episode)
        while seed in there:
            yield episode_path(journals, seed)
            seed = next(waiting, None)
    for left in seeds[len(seeds) if seed is None else seeds.index(seed) :]:
        if left in there:
            yield episode_path(journals, left)
        else:
            _LOG.warning("seed %d is left out: it killed its worker again and again", left)


def collect_successes(
    engine: Engine,
    job: RolloutJob,
    seeds: Sequence[int],
    count: int,
    journals: Path,
    on_episode: OnEpisode | None = None,
) -> Iterator[Path]:
    """Run seeds in order until `count` episodes succeeded; yields the journals of all of them, in seed order.

    Which episodes come out depends on the seeds alone. Raises `ManipError` where too few succeed.
    """
    tried, good = 0, 0
    while good < count:
        more = seeds[tried : tried + count - good]
        if tried + count - good > min(len(seeds), MAX_TRIES * count):
            raise ManipError(f"only {good} of {tried} demonstrations succeeded; {count} were asked for")
        tried += len(more)
        for path in collect(engine, job, more, journals, on_episode):
            good += read_header(path).success
            yield path


def record(
    episodes: Iterable[Path], journals: Path, root: Path, job: RolloutJob, recording: Recording, replace: bool = False
) -> tuple[DatasetInfo, int]:
    """Write the dataset as the episodes come; its counts, and how many failed episodes were left out.

    `build(journals, root)` gives the same bytes later. replace: as in `new_folder`.
    """
    recording.write(journals)
    spec, fingerprint = env_spec(job.env, job.cameras), env_fingerprint(job.env, job.cameras)
    with recording.open(root, spec, fingerprint, replace=replace) as writer:
        builder = Builder(writer, recording)
        for path in episodes:
            builder.add(*read_journal(path))
        return builder.finish(), builder.failed


def provenance(job: RolloutJob) -> dict[str, Any]:
    """Who drove, as datasets say it."""
    return {"driver": job.driver, "round": job.round, "beta": job.beta}


def check_journals(journals: Path, job: RolloutJob) -> list[str]:
    """Whether journals that are there already may be gone on with: `MismatchError`, or warnings to show.

    Every file is read; one that is damaged is set aside, so that its seed runs again.
    """
    clean_temporary(journals)
    warnings = set_aside_damaged(journals)
    paths = list_episodes(journals)
    if not paths:
        return warnings
    header, spec = read_header(paths[0]), env_spec(job.env, job.cameras)
    here = f"{job.env.robot} {job.env.task}"
    check_same_spec(str(journals), header.spec, here, spec)
    for what in ("task", "cameras", "image_size"):
        left, right = getattr(header.spec, what), getattr(spec, what)
        if left != right:
            raise MismatchError(what, str(journals), left, here, right)
    fingerprint = env_fingerprint(job.env, job.cameras)
    return warnings + compare_fingerprints(str(journals), header.fingerprint, "this machine", fingerprint)
