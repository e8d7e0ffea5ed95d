"""Pools of workers: the interface of a backend, the tasks that it gets, its messages, and the work of one task."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from manip_il.errors import ManipError
from manip_il.mdp import Episode
from manip_il.sim.config import CameraConfig, EnvConfig


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


class Keep(Protocol):
    """Stores finished episodes; must pickle."""

    def pack(self, episode: Episode) -> Any:
        """Make what is stored; called in the process that ran the episode."""
        ...

    def store(self, seed: int, packed: Any) -> None:
        """Store it; called on the machine with the disk: on a cluster in the engine's process, else in the worker."""
        ...


@dataclass(frozen=True, eq=False)
class Task:
    """Some seeds of one job."""

    job: Job
    seeds: tuple[int, ...]
    keep: Keep | None


@dataclass(frozen=True)
class Message:
    """Message of a worker: an episode ended, all did, the worker died, or the work itself failed.

    episode: without pictures. packed: what is still to be stored in the engine's process.
    """

    kind: Literal["episode", "done", "died", "failed"]
    episode: Episode | None = None
    packed: Any = None
    error: BaseException | None = None


class Pool(Protocol):
    """Workers of one backend."""

    @property
    def workers(self) -> int:
        """Tasks that run at once."""
        ...

    def has_room(self) -> bool:
        """Return whether another task can start at once."""
        ...

    def submit(self, task: Task) -> None:
        """Start a task."""
        ...

    def wait(self) -> list[tuple[Task, Message]]:
        """Wait until tasks have messages; returns at least one."""
        ...

    def close(self, in_order: bool) -> None:
        """End all workers; those still at work are killed unless all is `in_order`."""
        ...


def run_task(get_task: Callable[[], Task], store: bool) -> Iterator[Message]:
    """Run a task in a worker: yields a message for each episode as it ends, and one for the end or a failure.

    store: whether episodes are stored here, or in the engine's process.
    """
    try:
        task = get_task()
        for episode in task.job.run(task.seeds):
            packed = task.keep.pack(episode) if task.keep is not None else None
            if store and task.keep is not None:
                task.keep.store(episode.seed, packed)
            yield Message("episode", episode.without_pictures(), None if store else packed)
        yield Message("done")
    except Exception as error:
        yield Message("failed", error=portable(error))


def portable(error: Exception) -> Exception:
    """Return the error in a form that pickles: the program's own as it is, others in words."""
    return error if isinstance(error, ManipError) else ManipError(f"{type(error).__name__}: {error}")
