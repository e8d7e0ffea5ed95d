"""Run rollout jobs in this process, in local processes, or on a Ray cluster.

Each seed of a job always gives the same episode. If a local worker dies, the run ends with one
error, and can be resumed; Ray runs the seeds of a worker or node that died again by itself.

Processes are forked from a server that has only imported what they need. So they inherit neither
OpenGL nor threads, and the slow import of torch runs once. They end with the process that started
them, even if that is killed.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import islice
from multiprocessing import forkserver, resource_tracker
from typing import TYPE_CHECKING, Literal, Union

from manip_il.collect.job import RolloutJob
from manip_il.data.journal import Journal
from manip_il.errors import ManipError, UsageError, told
from manip_il.mdp import Episode

if TYPE_CHECKING:
    from manip_il.collect.ray_pool import RayPool

Backend = Literal["local", "ray"]
Seeds = tuple[int, ...]
Pool = Union["LocalPool", "RayPool"]
_CONTEXT = multiprocessing.get_context("forkserver")


class Engine:
    """Runs rollout jobs; use it as a context manager. Workers live as long as the engine.

    Args:
        workers: Number of processes, 1 for this process alone; on Ray the number of concurrent
            tasks; None for one per core.
        backend: Where the workers run: `local` for this machine, `ray` for a Ray cluster.

    Raises:
        UsageError: if `workers` is less than 1.
    """

    def __init__(self, workers: int | None = 1, backend: Backend = "local"):
        if workers is not None and workers < 1:
            raise UsageError(f"workers is {workers}; expected at least 1")
        self.workers = default_workers() if workers is None and backend == "local" else workers
        self._backend: Backend = backend
        self._pool: Pool | None = None

    def run(
        self, job: RolloutJob, seeds: Sequence[int], journal: Journal | None = None
    ) -> Iterator[Episode]:
        """Yield one episode per seed, in no fixed order, when it has ended and is in the journal.

        Episodes from other processes come without pictures.

        Args:
            job: The job to which the seeds belong.
            seeds: One for each episode.
            journal: Where finished episodes are written; None to write none.

        Raises:
            ManipError: if a worker dies; also what the job raises.
        """
        if self._backend == "local" and (
            self.workers == 1 or (len(seeds) == 1 and self._pool is None)
        ):
            yield from run_seeds(job, seeds, journal)
            return
        self._pool = self._pool or self._open()
        try:
            with _deaths_told():
                for episodes in self._results(self._pool, job, seeds, journal):
                    yield from episodes
        except BaseException:
            self._close()  # running episodes are no longer needed
            raise

    def warm_up(self, learned: bool) -> None:
        """Start the workers' server in the background.

        Args:
            learned: Whether the workers will run policies.
        """
        if self._backend == "local" and self.workers != 1:
            start_server(learned)

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *error: object) -> None:
        self._close()

    def _open(self) -> Pool:
        if self._backend == "local":
            return LocalPool(self.workers or 1)
        from manip_il.collect.ray_pool import RayPool  # imported here because Ray is an extra

        return RayPool(self.workers)

    def _close(self) -> None:
        if self._pool is not None:
            self._pool.close()
            self._pool = None

    def _results(
        self, pool: Pool, job: RolloutJob, seeds: Sequence[int], journal: Journal | None
    ) -> Iterator[list[Episode]]:
        """Yield the tasks' results."""
        tasks = split(job, seeds, pool.count)
        running = set[Future[list[Episode]]]()
        while tasks or running:
            while tasks and len(running) < pool.count:
                running.add(pool.submit(job, tasks.popleft(), journal))
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                running.remove(future)
                yield future.result()


def engine_of(workers: int | Engine | None) -> AbstractContextManager[Engine]:
    """Return the context of a new engine, or of a given one, which stays open."""
    return nullcontext(workers) if isinstance(workers, Engine) else Engine(workers)


class LocalPool:
    """Local processes, which start when the first task is submitted."""

    def __init__(self, count: int):
        self.count = count
        self._pool: ProcessPoolExecutor | None = None

    def submit(
        self, job: RolloutJob, seeds: Seeds, journal: Journal | None
    ) -> Future[list[Episode]]:
        """Submit some seeds of a job.

        Args:
            job: The job to which the seeds belong.
            seeds: One for each episode of the task.
            journal: Where the worker writes finished episodes; None to write none.

        Returns:
            The future of the episodes, which come without pictures.
        """
        self._pool = self._pool or open_pool(self.count, learned=job.policy is not None)
        return self._pool.submit(_in_worker, run_task, job, seeds, journal)

    def close(self) -> None:
        """Kill all processes."""
        if self._pool is not None:
            kill_pool(self._pool)
            self._pool = None


def map_in_order[T, R](
    function: Callable[[T], R], items: Iterable[T], workers: int
) -> Generator[tuple[T, R]]:
    """Yield each item with its result, in order; at most `workers` + 1 of them are in memory.

    Args:
        function: Computes an item's result.
        items: Taken one by one.
        workers: Number of processes. With 1 this process does the work, else items and results are
            pickled.

    Raises:
        ManipError: if a worker dies.
    """
    if workers == 1:
        yield from ((item, function(item)) for item in items)
        return
    pool, items = open_pool(workers), iter(items)
    try:
        with _deaths_told():
            waiting = deque(
                (item, pool.submit(_in_worker, function, item))
                for item in islice(items, workers + 1)
            )
            while waiting:
                item, result = waiting.popleft()
                yield item, result.result()
                waiting.extend(
                    (item, pool.submit(_in_worker, function, item)) for item in islice(items, 1)
                )
    finally:
        kill_pool(pool)


@contextmanager
def _deaths_told() -> Iterator[None]:
    """Raise `ManipError` where a worker has died."""
    try:
        yield
    except BrokenExecutor as error:
        raise ManipError("a worker died (out of memory?); try fewer --workers") from error


def open_pool(workers: int, *, learned: bool = False) -> ProcessPoolExecutor:
    """Return a pool of processes, which start on demand.

    Args:
        workers: Largest number of processes.
        learned: As in `start_server`.
    """
    start_server(learned)
    return ProcessPoolExecutor(workers, mp_context=_CONTEXT, initializer=_end_with_parent)


def kill_pool(pool: ProcessPoolExecutor) -> None:
    """Kill a pool's processes."""
    running = pool._processes or {}  # pyright: ignore[reportPrivateUsage]  # public from 3.14 on
    for process in list(running.values()):
        process.kill()
    pool.shutdown(cancel_futures=True)


def start_server(learned: bool) -> None:
    """Start, once per process, the background server that workers are forked from.

    The server keeps the current environment variables, but uses one OpenMP thread.

    Args:
        learned: Whether to also import policies.
    """
    _CONTEXT.set_forkserver_preload(
        ["manip_il.collect.job", *(["manip_il.learn.policy"] if learned else [])]
    )
    threads = os.environ.get("OMP_NUM_THREADS")
    resource_tracker.ensure_running()  # first, because starting it would undo the mask
    # only this process handles Ctrl-C
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
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
    """Yield each seed's episode when it has ended and is in the journal.

    Args:
        job: The job to which the seeds belong.
        seeds: One for each episode.
        journal: Where finished episodes are written; None to write none.
    """
    for episode in job.run(seeds):
        if journal is not None:
            journal.write(episode)
        yield episode


def run_task(job: RolloutJob, seeds: Seeds, journal: Journal | None) -> list[Episode]:
    """Run some seeds in a local worker, and return their episodes without pictures.

    Args:
        job: The job to which the seeds belong.
        seeds: One for each episode.
        journal: Where finished episodes are written; None to write none.
    """
    return [episode.without_pictures() for episode in run_seeds(job, seeds, journal)]


def _in_worker[**P, R](function: Callable[P, R], *arguments: P.args, **options: P.kwargs) -> R:
    """Call a function in a worker.

    Raises `ManipError` for any exception: it may not be picklable.
    """
    try:
        return function(*arguments, **options)
    except ManipError:
        raise
    except Exception as error:
        raise ManipError(told(error)) from None


def split(job: RolloutJob, seeds: Sequence[int], workers: int) -> deque[Seeds]:
    """Split seeds into tasks for workers.

    A task is one seed or, if a learner drives, a batch that is small enough to keep all workers
    busy.

    Args:
        job: The job to which the seeds belong.
        seeds: One for each episode.
        workers: Number of tasks that run at once.

    Returns:
        The tasks, in the order of the seeds.
    """
    size = 1 if job.policy is None else max(1, min(job.batch, -(-len(seeds) // workers)))
    return deque(tuple(seeds[i : i + size]) for i in range(0, len(seeds), size))


def default_workers() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))
