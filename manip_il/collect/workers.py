"""Runs rollout jobs: in this process, in processes of this machine, or on a Ray cluster.

Each seed of a job gives one episode, the same one wherever and however often it runs. So a worker that dies costs
nothing but time: what it had not finished runs again, each seed alone, so that the one that kills its worker is known.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from types import TracebackType
from typing import TYPE_CHECKING, Literal, Union

from manip_il.child_processes import kill_pool, open_pool, start_server
from manip_il.collect.job import RolloutJob
from manip_il.data.journal import Journal
from manip_il.errors import ManipError, UsageError
from manip_il.mdp import Episode

if TYPE_CHECKING:
    from manip_il.collect.ray_pool import RayPool

MAX_DEATHS = 3  # of workers that ran one seed alone, before it is left out; so many seeds in a row end the work
Backend = Literal["local", "ray"]
Seeds = tuple[int, ...]
Pool = Union["LocalPool", "RayPool"]
_EVERY_JOB, _LEARNED_JOB = ("manip_il.collect.job",), ("manip_il.collect.job", "manip_il.learn.policy")


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

    def run(self, job: RolloutJob, seeds: Sequence[int], journal: Journal | None = None) -> Iterator[Episode]:
        """Yield one episode a seed as they end, in no fixed order, each once it is in the journal.

        Pictures stay in the process that made them: episodes from another one come without. Raises what the work
        raises, and `ManipError` if workers die without one episode getting done.
        """
        wanted = [seed for seed in seeds if seed not in self.given_up]
        if self._backend == "local" and (self.workers == 1 or (len(wanted) == 1 and self._pool is None)):
            yield from run_seeds(job, wanted, journal)
            return
        self._pool = self._pool or self._open()
        try:
            for episodes in self._results(self._pool, job, wanted, journal):
                yield from episodes
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

    def _open(self) -> Pool:
        if self._backend == "local":
            return LocalPool(self.workers or 1)
        from manip_il.collect.ray_pool import RayPool  # here, as Ray is an extra

        return RayPool(self.workers)

    def _close(self, in_order: bool) -> None:
        if self._pool is not None:
            self._pool.close(in_order)
            self._pool = None

    def _results(
        self, pool: Pool, job: RolloutJob, seeds: Sequence[int], journal: Journal | None
    ) -> Iterator[list[Episode]]:
        """Yield what tasks give; the seeds of those whose worker died run again, one by one."""
        tasks, running = split(job, seeds, pool.count), dict[Future[list[Episode]], Seeds]()
        barren = 0  # seeds given up in a row
        while tasks or running:
            while tasks and len(running) < pool.count:
                task = tasks.popleft()
                running[pool.submit(job, task, journal)] = task
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            lost: list[int] = []
            for future in done:
                task = running.pop(future)
                if isinstance(future.exception(), BrokenExecutor):
                    lost += task
                else:
                    barren = 0
                    yield future.result()
            for seed in lost:
                episodes = _run_alone(pool, job, seed, journal)
                if episodes is None:
                    self.given_up.append(seed)
                barren = 0 if episodes else barren + 1
                if barren == MAX_DEATHS:
                    raise ManipError(
                        f"rollout workers died one after the other, of seeds {self.given_up[-barren:]}; out of memory? "
                        "Finished episodes are kept"
                    )
                yield episodes or []


class LocalPool:
    """Processes of this machine."""

    def __init__(self, count: int):
        self.count = count
        self._pool: ProcessPoolExecutor | None = None

    def submit(self, job: RolloutJob, seeds: Seeds, journal: Journal | None) -> Future[list[Episode]]:
        """Start some seeds of a job, in new processes if one had died."""
        if self._pool is None:
            self._pool = open_pool(self.count, _LEARNED_JOB if job.policy else _EVERY_JOB)
        try:
            return self._pool.submit(run_task, job, seeds, journal)
        except BrokenExecutor:
            self.close(in_order=False)
            return self.submit(job, seeds, journal)

    def close(self, in_order: bool) -> None:
        """End all processes; those still at work are killed unless all is `in_order`."""
        if self._pool is not None:
            self._pool.shutdown() if in_order else kill_pool(self._pool)
            self._pool = None


def run_seeds(job: RolloutJob, seeds: Sequence[int], journal: Journal | None) -> Iterator[Episode]:
    """Yield the episodes of some seeds as they end, each once it is in the journal."""
    for episode in job.run(seeds):
        if journal is not None:
            journal.write(episode)
        yield episode


def run_task(job: RolloutJob, seeds: Seeds, journal: Journal | None) -> list[Episode]:
    """Return the episodes of some seeds, without pictures: what a worker of this machine does."""
    try:
        return [episode.without_pictures() for episode in run_seeds(job, seeds, journal)]
    except ManipError:
        raise
    except Exception as error:  # which need not pickle
        raise ManipError(f"{type(error).__name__}: {error}") from None


def split(job: RolloutJob, seeds: Sequence[int], workers: int) -> deque[Seeds]:
    """Return one seed a task; where a learner drives, a lockstep batch, smaller if that would leave a worker idle."""
    size = 1 if job.policy is None else max(1, min(job.batch, -(-len(seeds) // workers)))
    return deque(tuple(seeds[i : i + size]) for i in range(0, len(seeds), size))


def default_workers() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0))


def _run_alone(pool: Pool, job: RolloutJob, seed: int, journal: Journal | None) -> list[Episode] | None:
    """The episodes of a seed that runs with no other in its worker; None if every one of its workers died."""
    for _ in range(MAX_DEATHS):
        try:
            return pool.submit(job, (seed,), journal).result()
        except BrokenExecutor:
            continue
    return None
