"""Record episodes: run the seeds that have no journal, write each journal the moment it ends, and the dataset."""

from __future__ import annotations

import itertools
import logging
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.job import RolloutJob
from manip_il.collect.redraw import STATES, RedrawJob, write_states
from manip_il.collect.task import Job
from manip_il.collect.workers import Engine
from manip_il.data.build import Recording, dataset_sha256, local_id
from manip_il.data.episodes import Header
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.info import DatasetInfo
from manip_il.data.journal import (
    Journal,
    clean_temporary,
    episode_path,
    list_episodes,
    list_seeds,
    read_header,
    read_journal,
    set_aside,
)
from manip_il.data.schema import IMAGES, check_same_spec
from manip_il.errors import ManipError, MismatchError, OlderSchemaError
from manip_il.mdp import Episode

_LOG = logging.getLogger(__name__)
OnEpisode = Callable[[Episode], None]
_IN_MEMORY = 64  # episodes that may wait in memory; others are read again
_BETWEEN = 20  # at most so many are handed on between two that end, as there may be thousands from before
MAX_TRIES = 3  # times the asked number of episodes, before an expert that mostly fails is given up


@dataclass(frozen=True)
class Collected:
    """One episode on disk. entry: what `read_journal` gives, where it is in memory still; else None."""

    path: Path
    success: bool
    entry: tuple[Header, Episode] | None

    def read(self) -> tuple[Header, Episode]:
        """Return what `read_journal` gives."""
        return self.entry or read_journal(self.path)


def collect(
    engine: Engine, job: Job, seeds: Sequence[int], journals: Path, on_episode: OnEpisode | None = None
) -> Iterator[Collected]:
    """Run the seeds that have no journal in `journals` yet; each finished episode becomes one file at once.

    Yields them in the order of the seeds, as soon as all before one are there. A journal that was there is read when
    its turn comes; a damaged one is set aside, with a warning, and its seed runs again. A seed that kills its worker
    again and again is left out: a warning names it. on_episode is called once an episode is on disk; what it raises
    ends the run, and what is on disk stays.
    """
    spec, fingerprint = env_spec(job.env, job.cameras), env_fingerprint(job.env, job.cameras)
    keep, waiting = Journal(journals, spec, fingerprint), deque(seeds)
    on_disk = dict.fromkeys(list_seeds(journals))  # seed -> whether it succeeded, of those that were run here
    in_memory: dict[int, tuple[Header, Episode]] = {}

    def ready() -> Iterator[Collected]:
        while waiting and waiting[0] in on_disk:
            path, success = episode_path(journals, waiting[0]), on_disk[waiting[0]]
            entry = in_memory.pop(waiting[0], None)
            if success is None:
                entry = _read_or_set_aside(path)
                if entry is None:
                    del on_disk[waiting[0]]
                    return
                success = entry[0].success
            waiting.popleft()
            yield Collected(path, success, entry)

    while waiting:
        missing = [seed for seed in waiting if seed not in on_disk]
        for episode in engine.run(job, missing, keep):
            on_disk[episode.seed] = episode.success
            whole = job.cameras is None or any(key.startswith(IMAGES) for key in episode.columns)
            if whole and len(in_memory) < _IN_MEMORY:
                in_memory[episode.seed] = Header.of(episode, spec, fingerprint), episode
            if on_episode is not None:
                on_episode(episode)
            yield from itertools.islice(ready(), _BETWEEN)
        yield from ready()
        if waiting and waiting[0] in missing and waiting[0] not in on_disk:
            _LOG.warning("seed %d is left out: it repeatedly killed its worker", waiting.popleft())


def _read_or_set_aside(path: Path) -> tuple[Header, Episode] | None:
    """A journal; None for a damaged one, which is renamed, so that its seed is free."""
    try:
        return read_journal(path)
    except OlderSchemaError:
        raise  # nothing is wrong with it
    except ManipError as error:
        _LOG.warning("%s (set aside as %s)", error, set_aside(path).name)
        return None


def collect_successes(
    engine: Engine,
    job: Job,
    seeds: Sequence[int],
    count: int,
    journals: Path,
    on_episode: OnEpisode | None = None,
) -> Iterator[Collected]:
    """Run seeds in order until `count` episodes succeeded; yields all of them, in seed order.

    Which episodes come out depends on the seeds alone. Raises `ManipError` where too few succeed.
    """
    tried, good = 0, 0
    while good < count:
        more = seeds[tried : tried + count - good]
        if tried + count - good > min(len(seeds), MAX_TRIES * count):
            raise ManipError(f"only {good} of {tried} demonstrations succeeded; {count} are needed")
        tried += len(more)
        for collected in collect(engine, job, more, journals, on_episode):
            good += collected.success
            yield collected


def record(
    episodes: Iterable[Collected],
    journals: Path,
    root: Path,
    job: Job,
    recording: Recording,
    replace: bool = False,
) -> tuple[DatasetInfo, int]:
    """Write the dataset as the episodes come; its counts, and how many failed episodes were left out.

    `build(journals, root)` gives the same bytes later. replace: as in `new_folder`.
    """
    recording.write(journals)
    spec, fingerprint = env_spec(job.env, job.cameras), env_fingerprint(job.env, job.cameras)
    selection = recording.selection()
    with recording.open(root, spec, fingerprint, replace=replace) as writer:
        for episode in selection.take(collected.read() for collected in episodes):
            writer.add(episode)
        return writer.finish(recording.provenance | selection.provenance), selection.failed


def redraw(
    engine: Engine, source: Path, job: RedrawJob, root: Path, on_episode: OnEpisode | None = None
) -> DatasetInfo:
    """Write the dataset of a job's scenes of a dataset's states; its journals, in `job.files`, go once it is whole.

    A job that was killed goes on from them. Raises `NothingToLearnError` where no scene has a sound label.
    """
    for line in check_journals(job.files, job):
        _LOG.warning("%s", line)
    if not (job.files / STATES).is_file():
        write_states(source, job.files, job.seed)
    drawn = {"scenes": job.scenes, "branch_steps": job.branch_steps, "cameras": asdict(job.cameras)}
    vary = {"vary": [condition.to_json() for condition in job.conditions]} if job.conditions else {}
    about = {"redrawn": {"from": source.name, "sha256": dataset_sha256(source), **drawn, **vary}}
    recording = Recording(local_id(root.name), only_labelled=True, provenance=about, stills=True)
    info, _ = record(collect(engine, job, job.seeds, job.files, on_episode), job.files, root, job, recording)
    shutil.rmtree(job.files)
    return info


def provenance(job: RolloutJob) -> dict[str, Any]:
    """Return a job's driver, round and labels, as datasets name them, and the ranges that its episodes draw from.

    An episode's draws follow from these and its seed, by `Condition.draw`.
    """
    source: dict[str, Any] = {"driver": job.driver.name, "round": job.round, "beta": job.driver.beta}
    if job.conditions:
        source["vary"] = [condition.to_json() for condition in job.conditions]
    if not job.learned:
        return source
    steps = {"branch_steps": job.branch_steps} if job.label == "branch" else {}
    return {**source, "label": job.label, "query": str(job.query), **steps}


def check_journals(journals: Path, job: Job) -> list[str]:
    """Check that a recording may continue from these journals: `MismatchError`, or a list of warnings to show.

    The first that can be read speaks for all; `collect` reads the others when their turn comes.
    """
    clean_temporary(journals)
    header = next(filter(None, map(_header, list_episodes(journals))), None)
    if header is None:
        return []
    spec, here = env_spec(job.env, job.cameras), f"{job.env.robot} {job.env.task}"
    check_same_spec(str(journals), header.spec, here, spec)
    for what in ("task", "cameras", "image_size"):
        left, right = getattr(header.spec, what), getattr(spec, what)
        if left != right:
            raise MismatchError(what, str(journals), left, here, right)
    fingerprint = env_fingerprint(job.env, job.cameras)
    return compare_fingerprints(str(journals), header.fingerprint, "this machine", fingerprint)


def _header(path: Path) -> Header | None:
    try:
        return read_header(path)
    except OlderSchemaError:
        raise
    except ManipError:
        return None
