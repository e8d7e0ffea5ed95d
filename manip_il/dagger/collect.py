"""Episodes on disk: run what is missing, keep each one the moment it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.journal import clean_temporary, list_episodes, read_episode, read_header, write_episode
from manip_il.data.lerobot_io import DatasetInfo, write_dataset
from manip_il.data.schema import RobotTaskSpec, check_same_spec
from manip_il.engine.describe import env_fingerprint, env_spec
from manip_il.engine.jobs import RolloutJob
from manip_il.engine.local import Engine
from manip_il.errors import ManipError, MismatchError
from manip_il.mdp import Episode

OnEpisode = Callable[[Episode], None]
MAX_TRIES = 3  # times the asked number of episodes, before an expert that mostly fails is given up


def collect(
    engine: Engine, job: RolloutJob, seeds: Sequence[int], journals: Path, on_episode: OnEpisode | None = None
) -> None:
    """Run the seeds that have no journal in `journals` yet; each finished episode becomes one file at once.

    on_episode is called once an episode is on disk; what it raises ends the run, and what is on disk stays.
    """
    spec, fingerprint = env_spec(job.env), env_fingerprint(job.env)
    there = {read_header(path).seed for path in list_episodes(journals)}
    missing = [seed for seed in seeds if seed not in there]
    keep = partial(_write, journals, spec, fingerprint)
    for episode in engine.run(job, missing, keep):
        if on_episode is not None:
            on_episode(episode)


def collect_successes(
    engine: Engine,
    job: RolloutJob,
    seeds: Sequence[int],
    count: int,
    journals: Path,
    on_episode: OnEpisode | None = None,
) -> list[Path]:
    """Run seeds in order until `count` episodes succeeded; the journals of those, in seed order.

    Which episodes come out depends on the seeds alone. Raises `ManipError` where too few succeed.
    """
    tried = count
    while True:
        collect(engine, job, seeds[:tried], journals, on_episode)
        wanted = set(seeds[:tried])
        headers = [(path, read_header(path)) for path in list_episodes(journals)]
        good = [path for path, header in headers if header.success and header.seed in wanted]
        if len(good) >= count:
            return good[:count]
        missing = count - len(good)
        if tried + missing > min(len(seeds), MAX_TRIES * count):
            raise ManipError(f"only {len(good)} of {tried} demonstrations succeeded; {count} were asked for")
        tried += missing


def check_journals(journals: Path, job: RolloutJob) -> list[str]:
    """Whether journals that are there already may be gone on with: `MismatchError`, or warnings to show."""
    clean_temporary(journals)
    paths = list_episodes(journals)
    if not paths:
        return []
    header = read_header(paths[0])
    here = f"{job.env.robot} {job.env.task}"
    check_same_spec(str(journals), header.spec, here, env_spec(job.env))
    if header.spec.task != job.env.task:
        raise MismatchError("task", str(journals), header.spec.task, here, job.env.task)
    return compare_fingerprints(str(journals), header.fingerprint, "this machine", env_fingerprint(job.env))


def build_dataset(
    journals: Sequence[Path], root: Path, job: RolloutJob, repo_id: str, provenance: dict[str, Any]
) -> DatasetInfo:
    """The LeRobot dataset of some journals, in the order given."""
    return write_dataset(
        _read(journals),
        root,
        env_spec(job.env),
        repo_id=repo_id,
        fingerprint=env_fingerprint(job.env),
        provenance=provenance,
    )


def _write(journals: Path, spec: RobotTaskSpec, fingerprint: dict[str, Any], episode: Episode) -> None:
    write_episode(journals, episode, spec, fingerprint)


def _read(journals: Sequence[Path]) -> Iterator[Episode]:
    for path in journals:
        yield read_episode(path)
