"""Record episodes: run the seeds that have no journal, write each journal the moment it ends, and the dataset."""

from __future__ import annotations

import itertools
import logging
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data.journal import Journal, episode_path, list_seeds, read_journal
from manip_il.errors import ManipError
from manip_il.mdp import Episode

_LOG = logging.getLogger(__name__)
OnEpisode = Callable[[Episode], None]
_BETWEEN = 20  # at most so many are handed on between two that end, as there may be thousands from before
MAX_TRIES = 3  # times the asked number of episodes, before an expert that mostly fails is given up


def journal_of(journals: Path, job: RolloutJob) -> Journal:
    """Return the folder that a job's episodes are stored in."""
    return Journal(journals, env_spec(job.env, job.cameras), env_fingerprint(job.env, job.cameras))


def collect(
    engine: Engine, job: RolloutJob, seeds: Sequence[int], journals: Path, on_episode: OnEpisode | None = None
) -> Iterator[tuple[Journal, Episode]]:
    """Run the seeds that have no journal in `journals` yet; each finished episode becomes one file at once.

    Yields what `read_journal` gives of them in the order of the seeds, as soon as all before one are there. A seed that
    kills its worker again and again is left out: a warning names it. on_episode is called once an episode is on disk;
    what it raises ends the run, and what is on disk stays.
    """
    journal, waiting, on_disk = journal_of(journals, job), deque(seeds), set(list_seeds(journals))

    def ready() -> Iterator[tuple[Journal, Episode]]:
        while waiting and waiting[0] in on_disk:
            yield read_journal(episode_path(journals, waiting.popleft()))

    while waiting:
        missing = [seed for seed in waiting if seed not in on_disk]
        for episode in engine.run(job, missing, journal):
            on_disk.add(episode.seed)
            if on_episode is not None:
                on_episode(episode)
            yield from itertools.islice(ready(), _BETWEEN)
        yield from ready()
        if waiting:
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
