"""The one seam for where episodes run: in this process, in local processes, or on a Ray cluster.

A task is some seeds of one job; each seed gives one episode, the same one wherever and however often it runs. So a
worker that dies costs nothing but time: what it had not finished runs again, each seed alone, elsewhere.
"""

from __future__ import annotations

import os
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Literal, Protocol

from manip_il.engine.jobs import RolloutJob, run_job
from manip_il.errors import ManipError, UsageError
from manip_il.mdp import Episode

MAX_DEATHS = 3  # of workers that one seed may cost before it is left out
Where = Literal["local", "ray"]


class Keep(Protocol):
    """Puts a finished episode away; must pickle."""

    def pack(self, episode: Episode) -> Any:
        """Make what is stored; called in the process that ran the episode."""
        ...

    def store(self, seed: int, packed: Any) -> None:
        """Store it; called where the disk is: in that process too, but on a cluster in the one that asked."""
        ...


@dataclass(frozen=True, eq=False)
class Task:
    """Some seeds of one job."""

    job: RolloutJob
    seeds: tuple[int, ...]
    keep: Keep | None


@dataclass(frozen=True)
class Event:
    """What became of a task: an episode ended, all did, its worker died, or the work itself failed.

    episode: without pictures. packed: what is still to be stored here.
    """

    task: Task
    kind: Literal["episode", "done", "died", "failed"]
    episode: Episode | None = None
    packed: Any = None
    error: BaseException | None = None


class Place(Protocol):
    """Where tasks run."""

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

    def wait(self) -> list[Event]:
        """Block until something happened to the tasks that run; at least one event."""
        ...

    def close(self, in_order: bool) -> None:
        """Let go of all workers; those still at work are killed unless all is `in_order`."""
        ...


class Engine:
    """Runs rollout jobs; use as a context manager. Workers live as long as the engine.

    workers: processes, 1 for this one alone; on Ray the tasks that run at once; None for one a core. Seeds that were
    left out, as each of them killed its worker three times, are in `given_up`.
    """

    def __init__(self, workers: int | None = 1, where: Where = "local"):
        if workers is not None and workers < 1:
            raise UsageError(f"workers is {workers}; expected at least 1")
        self.workers = default_workers() if workers is None and where == "local" else workers
        self.where: Where = where
        self.given_up: list[int] = []
        self._place: Place | None = None

    def run(self, job: RolloutJob, seeds: Sequence[int], keep: Keep | None = None) -> Iterator[Episode]:
        """Yield one episode a seed as they end, in no fixed order, each once it is kept.

        Pictures stay in the process that made them: episodes from another one come without. Raises what the work
        raises, and `ManipError` where workers die without one episode getting done.
        """
        wanted = [seed for seed in seeds if seed not in self.given_up]
        if self.where == "local" and (self.workers == 1 or (len(wanted) == 1 and self._place is None)):
            yield from _run_here(job, wanted, keep)
            return
        if self._place is None:
            self._place = _open_place(self.where, self.workers)
        try:
            yield from self._schedule(self._place, _tasks(job, wanted, keep, self._place.workers))
        except BaseException:
            self._close(in_order=False)  # what still runs belongs to nobody any more
            raise

    def warm_up(self, learned: bool) -> None:
        """Begin to start what workers need, and return at once. learned: whether policies will drive."""
        if self.where == "local" and self.workers != 1:
            from manip_il.engine.local import start_server

            start_server(learned)

    def __enter__(self) -> Engine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close(in_order=kind is None)

    def _close(self, in_order: bool) -> None:
        if self._place is not None:
            self._place.close(in_order)
            self._place = None

    def _schedule(self, place: Place, waiting: deque[Task]) -> Iterator[Episode]:
        left: dict[Task, set[int]] = {}  # seeds of running tasks that have not ended
        deaths: Counter[int] = Counter()
        in_vain = 0  # deaths since an episode ended
        while waiting or left:
            while waiting and place.has_room():
                task = waiting.popleft()
                left[task] = set(task.seeds)
                place.submit(task)
            for event in place.wait():
                if event.kind == "failed":
                    assert event.error is not None
                    raise event.error
                if event.kind == "episode":
                    assert event.episode is not None
                    left[event.task].discard(event.episode.seed)
                    in_vain = 0
                    _store(event)
                    yield event.episode
                    continue
                unfinished = sorted(left.pop(event.task))
                if event.kind == "died":
                    in_vain += 1
                    self._bury(event.task, unfinished, deaths, waiting)
                    if in_vain > MAX_DEATHS * (place.workers + 1):
                        raise ManipError(
                            f"{in_vain} rollout workers died one after the other ({event.error}); "
                            "finished episodes are kept"
                        )

    def _bury(self, task: Task, unfinished: list[int], deaths: Counter[int], waiting: deque[Task]) -> None:
        """Have every unfinished seed run again, alone, so that the one that kills is known."""
        deaths.update(unfinished)
        for seed in reversed(unfinished):
            if deaths[seed] >= MAX_DEATHS:
                self.given_up.append(seed)
            else:
                waiting.appendleft(replace(task, seeds=(seed,)))  # next: whoever wants them in order waits for it


def run_task(task: Task) -> Iterator[tuple[Episode, Any]]:
    """In a worker: each episode as it ends, without pictures, and what there is to store of it."""
    for episode in run_job(task.job, task.seeds):
        yield episode.without_pictures(), task.keep.pack(episode) if task.keep is not None else None


def portable(error: Exception) -> Exception:
    """Return the error as it can travel between processes: ours as they are, others in words."""
    return error if isinstance(error, ManipError) else ManipError(f"{type(error).__name__}: {error}")


def _run_here(job: RolloutJob, seeds: Sequence[int], keep: Keep | None) -> Iterator[Episode]:
    for episode in run_job(job, seeds):
        if keep is not None:
            keep.store(episode.seed, keep.pack(episode))
        yield episode


def _store(event: Event) -> None:
    if event.packed is not None and event.task.keep is not None and event.episode is not None:
        event.task.keep.store(event.episode.seed, event.packed)


def _tasks(job: RolloutJob, seeds: Sequence[int], keep: Keep | None, workers: int) -> deque[Task]:
    """One seed a task; where a learner drives, a lockstep batch, smaller where that would leave a worker idle."""
    size = 1 if job.policy is None else max(1, min(job.batch, -(-len(seeds) // workers)))
    return deque(Task(job, tuple(seeds[i : i + size]), keep) for i in range(0, len(seeds), size))


def _open_place(where: Where, workers: int | None) -> Place:
    if where == "ray":
        from manip_il.engine.cluster import RayCluster

        return RayCluster(workers)
    from manip_il.engine.local import LocalProcesses

    return LocalProcesses(workers or default_workers())


def default_workers() -> int:
    """As many as this process may use cores."""
    return len(os.sched_getaffinity(0))
