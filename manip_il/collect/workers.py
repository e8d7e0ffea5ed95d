"""Runs rollout jobs: in this process, in processes of this machine, or on a Ray cluster.

Each seed of a job gives one episode, the same one wherever and however often it runs. So a worker that dies costs
nothing but time: what it had not finished runs again, each seed alone, so that the one that kills its worker is known.
"""

from __future__ import annotations

import os
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from types import TracebackType
from typing import Literal, Protocol

from manip_il.child_processes import kill_pool, open_pool, start_server
from manip_il.collect.task import Answer, Job, Seeds, run_seeds
from manip_il.data.journal import Journal
from manip_il.errors import ManipError, UsageError
from manip_il.mdp import Episode

MAX_DEATHS = 3  # of workers that ran one seed alone, before it is left out
Backend = Literal["local", "ray"]
_EVERY_JOB, _LEARNED_JOB = ("manip_il.collect.job",), ("manip_il.collect.job", "manip_il.learn.policy")


class Workers(Protocol):
    """Workers of one backend."""

    @property
    def died(self) -> tuple[type[BaseException], ...]:
        """Errors of a future whose worker died."""
        ...

    @property
    def count(self) -> int:
        """Tasks that run at once."""
        ...

    def submit(self, job: Job, seeds: Seeds, journal: Journal | None) -> Future[Answer]:
        """Start some seeds of a job."""
        ...

    def close(self, in_order: bool) -> None:
        """End all workers; those still at work are killed unless all is `in_order`."""
        ...


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
        self._pool: Workers | None = None

    def run(self, job: Job, seeds: Sequence[int], journal: Journal | None = None) -> Iterator[Episode]:
        """Yield one episode a seed as they end, in no fixed order, each once it is in the journal.

        Pictures stay in the process that made them: episodes from another one come without. Raises what the work
        raises, and `ManipError` if workers die without one episode getting done.
        """
        wanted = [seed for seed in seeds if seed not in self.given_up]
        if self._backend == "local" and (self.workers == 1 or (len(wanted) == 1 and self._pool is None)):
            yield from job.run(wanted) if journal is None else _stored(job.run(wanted), journal)
            return
        pool = self._pool = self._pool or _open_workers(self._backend, self.workers)
        try:
            for answer in self._answers(pool, job, wanted, journal):
                for episode, packed in answer:
                    if packed is not None and journal is not None:
                        journal.store(episode.seed, packed)
                    yield episode
        except BaseException:
            self._close(in_order=False)  # nobody takes the episodes that still run
            raise

    def warm_up(self, learned: bool) -> None:
        """Begin to start what workers need, and return at once. learned: whether policies will drive."""
        if self._backend == "local" and self.workers != 1:
            start_server(_LEARNED_JOB if learned else _EVERY_JOB)

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

    def _answers(self, pool: Workers, job: Job, seeds: Sequence[int], journal: Journal | None) -> Iterator[Answer]:
        """Yield what tasks answer; those whose worker died run again, seed by seed, with no other beside."""
        tasks, alone = split(job, seeds, pool.count), deque[Seeds]()
        running: dict[Future[Answer], Seeds] = {}
        deaths: Counter[int] = Counter()
        in_a_row = 0
        while tasks or alone or running:
            is_alone = bool(alone) and not running
            start = [alone.popleft()] if is_alone else []
            while tasks and not alone and not is_alone and len(running) + len(start) < pool.count:
                start.append(tasks.popleft())
            running |= {pool.submit(job, task, journal): task for task in start}
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                task = running.pop(future)
                try:
                    answer = future.result()
                except pool.died as death:
                    in_a_row += 1
                    if in_a_row > MAX_DEATHS * (pool.count + 1):
                        raise ManipError(
                            f"{in_a_row} rollout workers died one after the other ({death}); out of memory? Finished "
                            "episodes are kept"
                        ) from death
                    if is_alone:  # else another seed may have killed the worker
                        deaths.update(task)
                    self.given_up += [seed for seed in task if deaths[seed] >= MAX_DEATHS]
                    alone.extend((seed,) for seed in task if deaths[seed] < MAX_DEATHS)
                    continue
                in_a_row = 0
                yield answer


class LocalProcesses:
    """Processes of this machine."""

    died = (BrokenExecutor,)

    def __init__(self, count: int):
        self.count = count
        self._pool: ProcessPoolExecutor | None = None

    def submit(self, job: Job, seeds: Seeds, journal: Journal | None) -> Future[Answer]:
        """Start some seeds of a job, in new processes if one had died."""
        if self._pool is None:
            self._pool = open_pool(self.count, _LEARNED_JOB if job.learned else _EVERY_JOB)
        try:
            return self._pool.submit(run_seeds, job, seeds, journal, True)
        except BrokenExecutor:
            self.close(in_order=False)
            return self.submit(job, seeds, journal)

    def close(self, in_order: bool) -> None:
        """End all processes."""
        if self._pool is not None:
            self._pool.shutdown() if in_order else kill_pool(self._pool)
            self._pool = None


def split(job: Job, seeds: Sequence[int], workers: int) -> deque[Seeds]:
    """Return one seed a task; where a learner drives, a lockstep batch, smaller if that would leave a worker idle."""
    size = 1 if not job.learned else max(1, min(job.batch, -(-len(seeds) // workers)))
    return deque(tuple(seeds[i : i + size]) for i in range(0, len(seeds), size))


def _stored(episodes: Iterable[Episode], journal: Journal) -> Iterator[Episode]:
    """Yield episodes once they are stored; the disk takes each while the next one runs."""
    with ThreadPoolExecutor(1, "store") as disk:
        before: tuple[Episode, Future[None]] | None = None
        for episode in episodes:
            storing = episode, disk.submit(journal.store, episode.seed, journal.encode(episode))
            if before is not None:
                yield _settled(*before)
            before = storing
        if before is not None:
            yield _settled(*before)


def _settled(episode: Episode, stored: Future[None]) -> Episode:
    stored.result()
    return episode


def _open_workers(backend: Backend, workers: int | None) -> Workers:
    if backend == "local":
        return LocalProcesses(workers or default_workers())
    from manip_il.collect.ray_pool import RayCluster  # here, as Ray is an extra

    return RayCluster(workers)


def default_workers() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0))
