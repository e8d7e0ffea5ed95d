"""Runs rollout jobs: in this process, in processes of this machine, or on a Ray cluster.

Each seed of a job gives one episode, the same one wherever and however often it runs. So a worker that dies costs
nothing but time: what it had not finished runs again, each seed alone, so that the one that kills its worker is known.

Processes are forked from a server that has imported what they need and nothing else: they share neither OpenGL nor
threads, and the import of torch, seconds of work, is paid once. They end with the process that started them, also if
that was killed.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from itertools import islice
from multiprocessing import forkserver, resource_tracker
from typing import TYPE_CHECKING, Literal, Union

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
_CONTEXT = multiprocessing.get_context("forkserver")


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
            self._close()  # nobody takes the episodes that still run
            raise

    def warm_up(self, learned: bool) -> None:
        """Begin to start what workers need, and return at once. learned: whether policies will drive."""
        if self._backend == "local" and self.workers != 1:
            start_server(learned)

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *error: object) -> None:
        self._close()

    def _open(self) -> Pool:
        if self._backend == "local":
            return LocalPool(self.workers or 1)
        from manip_il.collect.ray_pool import RayPool  # here, as Ray is an extra

        return RayPool(self.workers)

    def _close(self) -> None:
        if self._pool is not None:
            self._pool.close()
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
    """Processes of this machine; new ones if one has died."""

    def __init__(self, count: int):
        self.count = count
        self._pool: ProcessPoolExecutor | None = None

    def submit(self, job: RolloutJob, seeds: Seeds, journal: Journal | None) -> Future[list[Episode]]:
        """Start some seeds of a job."""
        self._pool = self._pool or open_pool(self.count, learned=job.policy is not None)
        try:
            return self._pool.submit(run_task, job, seeds, journal)
        except BrokenExecutor:
            self.close()
            return self.submit(job, seeds, journal)

    def close(self) -> None:
        """End all processes, whatever they are doing."""
        if self._pool is not None:
            kill_pool(self._pool)
            self._pool = None


def map_in_order[T, R](function: Callable[[T], R], items: Iterable[T], workers: int) -> Generator[tuple[T, R]]:
    """Yield each item with its result, in order; at most `workers` + 1 of them wait in memory.

    One worker is this process. Items and results are pickled for others. Raises `ManipError` if a worker dies.
    """
    if workers == 1:
        yield from ((item, function(item)) for item in items)
        return
    pool, items = open_pool(workers), iter(items)
    try:
        waiting = deque((item, pool.submit(function, item)) for item in islice(items, workers + 1))
        while waiting:
            item, result = waiting.popleft()
            yield item, result.result()
            waiting.extend((item, pool.submit(function, item)) for item in islice(items, 1))
    except BrokenExecutor as error:
        raise ManipError("a worker died (out of memory?); fewer --workers need less") from error
    finally:
        kill_pool(pool)


def open_pool(workers: int, *, learned: bool = False) -> ProcessPoolExecutor:
    """Return a pool of so many processes, which are started as they are needed. learned: as in `start_server`."""
    start_server(learned)
    return ProcessPoolExecutor(workers, mp_context=_CONTEXT, initializer=_end_with_parent)


def kill_pool(pool: ProcessPoolExecutor) -> None:
    """End a pool's processes, whatever they are doing."""
    for process in list((pool._processes or {}).values()):  # pyright: ignore[reportPrivateUsage]  # public from 3.14 on
        process.kill()
    pool.shutdown(cancel_futures=True)


def start_server(learned: bool) -> None:
    """Start the server that workers are forked from, in the background; once a process.

    It imports jobs, and policies if workers are to be `learned`. It has the environment variables of this moment, but
    one thread for arithmetic.
    """
    _CONTEXT.set_forkserver_preload(["manip_il.collect.job", *(["manip_il.learn.policy"] if learned else [])])
    threads = os.environ.get("OMP_NUM_THREADS")
    resource_tracker.ensure_running()  # first, as its own start would undo the mask
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is for this process alone
    os.environ["OMP_NUM_THREADS"] = "1"  # read when torch is imported; one core each
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if threads is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = threads


def _end_with_parent() -> None:
    """End this worker when the process that started it ends."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)


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
