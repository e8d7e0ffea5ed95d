"""What workers do with an episode in these tests (imported by name in their processes), and what is left of it."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.job import RolloutJob
from manip_il.data.journal import Journal, list_episodes
from manip_il.mdp import Episode


def journal(folder: Path, job: RolloutJob) -> Journal:
    """Store the episodes of a job in a folder."""
    return Journal(folder, env_spec(job.env), env_fingerprint(job.env))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in list_episodes(folder)}


def written(episodes: Iterable[Episode]) -> dict[int, dict[str, bytes]]:
    """Seed -> column -> bytes."""
    return {e.seed: {key: column.tobytes() for key, column in e.columns.items()} for e in episodes}


@dataclass(frozen=True)
class DeadlyKeep:
    """Journals; but the process that packs one of `seeds` is killed, at most `times` times a seed.

    folder: where deaths are counted.
    """

    journals: Journal
    folder: Path
    seeds: tuple[int, ...]
    times: int

    @classmethod
    def of(cls, folder: Path, job: RolloutJob, *seeds: int, times: int = 1000) -> DeadlyKeep:
        (folder / "deaths").mkdir()
        return cls(journal(folder / "journals", job), folder / "deaths", seeds, times)

    def encode(self, episode: Episode) -> bytes:
        if episode.seed in self.seeds and self.deaths(episode.seed) < self.times:
            (self.folder / f"{episode.seed}-{os.getpid()}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return self.journals.encode(episode)

    def store(self, seed: int, packed: bytes) -> None:
        self.journals.store(seed, packed)

    def deaths(self, seed: int | str = "*") -> int:
        return len(list(self.folder.glob(f"{seed}-*")))


@dataclass(frozen=True)
class FailingKeep:
    """Cannot store anything."""

    def encode(self, episode: Episode) -> bytes:
        return b"x"

    def store(self, seed: int, packed: bytes) -> None:
        raise OSError(28, "No space left on device", f"episode of seed {seed}")
