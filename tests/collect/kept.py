"""What workers do with an episode in these tests (imported by name in their processes), and what
is left of it.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manip_il.collect.edits import label_states
from manip_il.collect.job import RolloutJob
from manip_il.collect.record import journal_of
from manip_il.data.journal import Journal, list_episodes
from manip_il.data.schema import SIM_STATE
from manip_il.mdp import Episode
from manip_il.worlds.config import EnvConfig


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in list_episodes(folder)}


def written(episodes: Iterable[Episode]) -> dict[int, dict[str, bytes]]:
    """Seed -> column -> bytes."""
    return {e.seed: {key: column.tobytes() for key, column in e.columns.items()} for e in episodes}


def label_all(piece: tuple[EnvConfig, Episode]) -> dict[str, Any]:
    """Labels of an episode's states, the last one first."""
    env, episode = piece
    return {
        key: column[::-1]
        for key, column in label_states(env, episode.columns[SIM_STATE][::-1]).items()
    }


@dataclass(frozen=True)
class DeadlyJournal(Journal):
    """The process that packs one of `seeds` is killed, at most `times` times a seed.

    Deaths are counted in `grave`.
    """

    grave: Path
    seeds: tuple[int, ...]
    times: int

    @classmethod
    def of(cls, folder: Path, job: RolloutJob, *seeds: int, times: int = 1000) -> DeadlyJournal:
        (folder / "deaths").mkdir()
        journal = journal_of(folder / "journals", job)
        return cls(
            journal.folder, journal.spec, journal.fingerprint, folder / "deaths", seeds, times
        )

    def encode(self, episode: Episode) -> bytes:
        if episode.seed in self.seeds and self.deaths(episode.seed) < self.times:
            (self.grave / f"{episode.seed}-{os.getpid()}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().encode(episode)

    def deaths(self, seed: int | str = "*") -> int:
        return len(list(self.grave.glob(f"{seed}-*")))
