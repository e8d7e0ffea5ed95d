"""Record episodes: run the seeds that have no journal yet, and write each journal as soon as its episode ends."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data.journal import Journal, episode_path, list_seeds, read_journal
from manip_il.errors import ManipError
from manip_il.mdp import Episode
from manip_il.sim.config import Look
from manip_il.worlds.table import env_fingerprint, env_spec

OnEpisode = Callable[[Episode], None]
MAX_TRIES = 3  # most tries, as a multiple of the requested successes


def journal_of(journals: Path, job: RolloutJob) -> Journal:
    """Return the journal folder of a job, with its spec and fingerprint."""
    return Journal(journals, env_spec(job.env, job.cameras), env_fingerprint(job.env, job.cameras))


def collect(
    engine: Engine, job: RolloutJob, seeds: Sequence[int], journals: Path, on_episode: OnEpisode | None = None
) -> Iterator[tuple[Journal, Episode]]:
    """Run the seeds that have no journal in `journals` yet; each finished episode is written at once.

    Yields what `read_journal` returns for each seed, in seed order, as soon as all earlier seeds are done. on_episode:
    called when an episode is on disk; an exception in it ends the run, and finished episodes stay on disk.
    """
    journal = journal_of(journals, job)
    waiting = deque(seeds)
    on_disk = set(list_seeds(journals))

    def ready() -> Iterator[tuple[Journal, Episode]]:
        while waiting and waiting[0] in on_disk:
            yield read_journal(episode_path(journals, waiting.popleft()))

    yield from ready()
    for episode in engine.run(job, [seed for seed in waiting if seed not in on_disk], journal):
        on_disk.add(episode.seed)
        if on_episode is not None:
            on_episode(episode)
        yield from ready()


def collect_successes(
    engine: Engine,
    job: RolloutJob,
    seeds: Sequence[int],
    count: int,
    journals: Path,
    on_episode: OnEpisode | None = None,
) -> Iterator[tuple[Journal, Episode]]:
    """Run seeds in order until `count` episodes have succeeded; yield all episodes as `collect` does.

    The episodes depend on the seeds alone. Raises `ManipError` if too few succeed.
    """
    tried, good = 0, 0
    while good < count:
        more = seeds[tried : tried + count - good]
        if tried + count - good > min(len(seeds), MAX_TRIES * count):
            raise ManipError(
                f"only {good} of {tried} demonstrations succeeded; {count} are needed; "
                "measure the expert first: manip-il eval --policy.type=expert"
            )
        tried += len(more)
        for journal, episode in collect(engine, job, more, journals, on_episode):
            good += episode.success
            yield journal, episode


def provenance(job: RolloutJob) -> dict[str, Any]:
    """Return a job's driver, round, labels and randomisation, as stored in datasets.

    An episode's random draws follow from these and its seed, by `Condition.draw`.
    """
    source: dict[str, Any] = {"driver": job.driver.name, "round": job.round, "beta": job.driver.beta}
    if job.conditions:
        source["vary"] = [condition.to_json() for condition in job.conditions]
    if job.cameras and job.cameras.look != Look():
        source["rendered"] = {"cameras": asdict(job.cameras)}
    if job.policy is None:
        return source
    steps = {"branch_steps": job.branch_steps} if job.label == "branch" else {}
    return {**source, "label": job.label, "query": str(job.query), **steps}
