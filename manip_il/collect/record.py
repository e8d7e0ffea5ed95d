"""Record episodes: run the seeds that have no journal, write each journal the moment it ends, and the dataset."""

from __future__ import annotations

import itertools
import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data.build import Recording
from manip_il.data.info import Info
from manip_il.data.journal import Journal, list_seeds
from manip_il.data.schema import IMAGES
from manip_il.errors import ManipError
from manip_il.mdp import Episode

_LOG = logging.getLogger(__name__)
OnEpisode = Callable[[Episode], None]
_IN_MEMORY = 64  # episodes that may wait in memory; others are read again
_BETWEEN = 20  # at most so many are handed on between two that end, as there may be thousands from before
MAX_TRIES = 3  # times the asked number of episodes, before an expert that mostly fails is given up


def journal_of(journals: Path, job: RolloutJob) -> Journal:
    """Return the folder that a job's episodes are stored in."""
    return Journal(journals, env_spec(job.env, job.cameras), env_fingerprint(job.env, job.cameras))


def collect(
    engine: Engine, job: RolloutJob, seeds: Sequence[int], journals: Path, on_episode: OnEpisode | None = None
) -> Iterator[tuple[Journal, Episode]]:
    """Run the seeds that have no journal in `journals` yet; each finished episode becomes one file at once.

    Yields what `read_journal` gives of them in the order of the seeds, as soon as all before one are there. A journal
    that was there is read when its turn comes; a damaged one is set aside, with a warning, and its seed runs again. A
    seed that kills its worker again and again is left out: a warning names it. on_episode is called once an episode is
    on disk; what it raises ends the run, and what is on disk stays.
    """
    journal, waiting = journal_of(journals, job), deque(seeds)
    on_disk = set(list_seeds(journals))
    in_memory: dict[int, Episode] = {}

    def ready() -> Iterator[tuple[Journal, Episode]]:
        while waiting and waiting[0] in on_disk:
            episode = in_memory.pop(waiting[0], None)
            entry = journal.read(waiting[0]) if episode is None else (journal, episode)
            if entry is None:
                on_disk.remove(waiting[0])
                return
            waiting.popleft()
            yield entry

    while waiting:
        missing = [seed for seed in waiting if seed not in on_disk]
        for episode in engine.run(job, missing, journal):
            on_disk.add(episode.seed)
            whole = job.cameras is None or any(key.startswith(IMAGES) for key in episode.columns)
            if whole and len(in_memory) < _IN_MEMORY:
                in_memory[episode.seed] = episode
            if on_episode is not None:
                on_episode(episode)
            yield from itertools.islice(ready(), _BETWEEN)
        yield from ready()
        if waiting and waiting[0] in missing and waiting[0] not in on_disk:
            _LOG.warning("seed %d is left out: it repeatedly killed its worker", waiting.popleft())


def collect_successes(
    engine: Engine,
    job: RolloutJob,
    seeds: Sequence[int],
    count: int,
    journals: Path,
    on_episode: OnEpisode | None = None,
) -> Iterator[tuple[Journal, Episode]]:
    """Run seeds in order until `count` episodes succeeded; yields all of them as `collect` does.

    Which episodes come out depends on the seeds alone. Raises `ManipError` where too few succeed.
    """
    tried, good = 0, 0
    while good < count:
        more = seeds[tried : tried + count - good]
        if tried + count - good > min(len(seeds), MAX_TRIES * count):
            raise ManipError(f"only {good} of {tried} demonstrations succeeded; {count} are needed")
        tried += len(more)
        for journal, episode in collect(engine, job, more, journals, on_episode):
            good += episode.success
            yield journal, episode


def record(
    episodes: Iterable[tuple[Journal, Episode]],
    journals: Path,
    root: Path,
    job: RolloutJob,
    recording: Recording,
    replace: bool = False,
) -> tuple[Info, int]:
    """Write the dataset as the episodes come; its counts, and how many failed episodes were left out.

    `build(journals, root)` gives the same bytes later. replace: as in `new_folder`.
    """
    recording.write(journals)
    return recording.make(episodes, root, replace=replace)


def provenance(job: RolloutJob) -> dict[str, Any]:
    """Return a job's driver, round and labels, as datasets name them, and the ranges that its episodes draw from.

    An episode's draws follow from these and its seed, by `Condition.draw`.
    """
    source: dict[str, Any] = {"driver": job.driver.name, "round": job.round, "beta": job.driver.beta}
    if job.conditions:
        source["vary"] = [condition.to_json() for condition in job.conditions]
    if job.policy is None:
        return source
    steps = {"branch_steps": job.branch_steps} if job.label == "branch" else {}
    return {**source, "label": job.label, "query": str(job.query), **steps}
