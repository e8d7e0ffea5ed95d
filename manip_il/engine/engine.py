"""Runs episodes in this process, in local processes, or on a Ray cluster.

A task is some seeds of one job; each seed gives one episode, the same one wherever and however often it runs. So a
worker that dies costs nothing but time: the seeds that it had not finished run again, each alone, in other workers.
"""

from __future__ import annotations

import os
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from types import TracebackType
from typing import Literal

from manip_il.engine.local import LocalProcesses, start_server
from manip_il.engine.pool import Job, Keep, Pool, Task
from manip_il.errors import ManipError, UsageError
from manip_il.mdp import Episode

MAX_DEATHS = 3  # of workers that one seed may cost before it is left out
Backend = Literal["local", "ray"]


class Engine:
    """Runs rollout jobs; use as a context manager. Workers live as long as the engine.

    workers: processes, 1 for this one alone; on Ray the tasks that run at once; None for one a core. Seeds that were
    left out, as each of them killed its worker three times, are in `given_up`.
    """

    def __init__(self, workers: int | None = 1, backend: Backend = "local"):
        if workers is not None and workers < 1:
            raise UsageError(f"workers is {workers}; expected at least 1")
        self.workers = default_workers() if workers is None and backend == "local" else workers
        self.given_up: list[int] = []
        self._backend: Backend = backend
        self._pool: Pool | None = None

    def run(self, job: Job, seeds: Sequence[int], keep: Keep | None = None) -> Iterator[Episode]:
        """Yield one episode a seed as they end, in no fixed order, each once it is kept.

        Pictures stay in the process that made them: episodes from another one come without. Raises what the work
        raises, and `ManipError` where workers die without one episode getting done.
        """
        wanted = [seed for seed in seeds if seed not in self.given_up]
        if self._backend == "local" and (self.workers == 1 or (len(wanted) == 1 and self._pool is None)):
            yield from job.run(wanted) if keep is None else _stored(job.run(wanted), keep)
            return
        if self._pool is None:
            self._pool = _open_pool(self._backend, self.workers)
        try:
            yield from self._schedule(self._pool, _tasks(job, wanted, keep, self._pool.workers))
        except BaseException:
            self._close(in_order=False)  # nobody takes the episodes that still run
            raise

    def warm_up(self, learned: bool) -> None:
        """Begin to start what workers need, and return at once. learned: whether policies will drive."""
        if self._backend == "local" and self.workers != 1:
            start_server(learned)

    def __enter__(self) -> Engine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close(in_order=kind is None)

    def _close(self, in_order: bool) -> None:
        if self._pool is not None:
            self._pool.close(in_order)
            self._pool = None

    def _schedule(self, pool: Pool, waiting: deque[Task]) -> Iterator[Episode]:
        left: dict[Task, set[int]] = {}  # seeds of running tasks that have not ended
        deaths: Counter[int] = Counter()
        deaths_without_progress = 0
        while waiting or left:
            while waiting and pool.has_room():
                task = waiting.popleft()
                left[task] = set(task.seeds)
                pool.submit(task)
            for task, message in pool.wait():
                if message.kind == "failed":
                    assert message.error is not None
                    raise message.error
                if message.kind == "episode":
                    assert message.episode is not None
                    left[task].discard(message.episode.seed)
                    deaths_without_progress = 0
                    if message.packed is not None and task.keep is not None:
                        task.keep.store(message.episode.seed, message.packed)
                    yield message.episode
                    continue
                unfinished = sorted(left.pop(task))
                if message.kind == "died":
                    deaths_without_progress += 1
                    self._retry(task, unfinished, deaths, waiting)
                    if deaths_without_progress > MAX_DEATHS * (pool.workers + 1):
                        raise ManipError(
                            f"{deaths_without_progress} rollout workers died one after the other ({message.error}); "
                            "finished episodes are kept"
                        )

    def _retry(self, task: Task, unfinished: list[int], deaths: Counter[int], waiting: deque[Task]) -> None:
        """Have every unfinished seed run again, alone, so that the one that kills is known."""
        deaths.update(unfinished)
        for seed in reversed(unfinished):
            if deaths[seed] >= MAX_DEATHS:
                self.given_up.append(seed)
            else:
                waiting.appendleft(replace(task, seeds=(seed,)))  # next: whoever wants them in order waits for it


def _stored(episodes: Iterable[Episode], keep: Keep) -> Iterator[Episode]:
    """Yield episodes once they are stored; the disk takes each while the next one runs."""
    with ThreadPoolExecutor(1, "store") as disk:
        before: tuple[Episode, Future[None]] | None = None
        for episode in episodes:
            storing = episode, disk.submit(keep.store, episode.seed, keep.pack(episode))
            if before is not None:
                yield _settled(*before)
            before = storing
        if before is not None:
            yield _settled(*before)


def _settled(episode: Episode, stored: Future[None]) -> Episode:
    stored.result()
    return episode


def _tasks(job: Job, seeds: Sequence[int], keep: Keep | None, workers: int) -> deque[Task]:
    """One seed a task; where a learner drives, a lockstep batch, smaller where that would leave a worker idle."""
    size = 1 if not job.learned else max(1, min(job.batch, -(-len(seeds) // workers)))
    return deque(Task(job, tuple(seeds[i : i + size]), keep) for i in range(0, len(seeds), size))


def _open_pool(backend: Backend, workers: int | None) -> Pool:
    if backend == "local":
        return LocalProcesses(workers or default_workers())
    from manip_il.engine.cluster import RayCluster  # here, as Ray is an extra

    return RayCluster(workers)


def default_workers() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0))
