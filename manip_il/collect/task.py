"""The work of one worker: some seeds of one job, whose episodes it stores or sends home."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

from manip_il.data.journal import Journal
from manip_il.errors import ManipError
from manip_il.mdp import Episode
from manip_il.sim.config import CameraConfig, EnvConfig

Seeds = tuple[int, ...]
Answer = list[tuple[Episode, bytes | None]]
"""Episodes without pictures, each with its journal if that is still to be stored."""


class Job(Protocol):
    """Work that makes episodes of seeds; must pickle, and depend on nothing else."""

    @property
    def env(self) -> EnvConfig:
        """Environment of its episodes."""
        ...

    @property
    def cameras(self) -> CameraConfig | None:
        """Cameras whose pictures its episodes have."""
        ...

    @property
    def learned(self) -> bool:
        """Whether it needs a policy, which takes torch and memory."""
        ...

    @property
    def batch(self) -> int:
        """Seeds that are run together at most, where it is learned."""
        ...

    @property
    def files(self) -> Path | None:
        """A folder that workers on other machines need a copy of."""
        ...

    def with_files(self, files: Path) -> Job:
        """Return the same where its folder has been copied to."""
        ...

    def run(self, seeds: Sequence[int]) -> Iterator[Episode]:
        """Yield one episode a seed, in the order in which they end."""
        ...


def run_seeds(job: Job, seeds: Seeds, journal: Journal | None, store: bool) -> Answer:
    """Run some seeds of a job in a worker. store: journals here, else whoever asked for them has the disk."""
    found: Answer = []
    try:
        for episode in job.run(seeds):
            packed = journal.encode(episode) if journal is not None else None
            if store and journal is not None and packed is not None:
                journal.store(episode.seed, packed)
                packed = None
            found.append((episode.without_pictures(), packed))
    except ManipError:
        raise
    except Exception as error:  # which need not pickle
        raise ManipError(f"{type(error).__name__}: {error}") from None
    return found
