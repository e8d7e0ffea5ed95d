"""Where episodes run: in this process or in local ones. Either way the same episodes, bit for bit."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from types import TracebackType

from manip_il.engine.jobs import LOCKSTEP, RolloutJob, run_job
from manip_il.errors import ManipError, UsageError
from manip_il.mdp import Episode

Keep = Callable[[Episode], object]


class Engine:
    """Runs rollout jobs with `workers` processes (1: in this one); use as a context manager.

    The processes live as long as the engine, so that a command pays for their start once.
    """

    def __init__(self, workers: int = 1):
        if workers < 1:
            raise UsageError(f"workers is {workers}; expected at least 1")
        self.workers = workers
        self._pool: ProcessPoolExecutor | None = None

    def run(self, job: RolloutJob, seeds: Sequence[int], keep: Keep | None = None) -> Iterator[Episode]:
        """Yield one episode a seed as they end, in no fixed order. Raises `ManipError` where a worker dies.

        keep: called in the process that ran an episode, the moment it ends (to write it to disk, say); must pickle.
        """
        if self.workers == 1 or len(seeds) == 1:
            yield from _run(job, seeds, keep)
            return
        pool = self._start()
        waiting: set[Future[list[Episode]]] = set()
        try:
            for chunk in _chunks(seeds, self.workers):
                waiting.add(pool.submit(_run_chunk, job, chunk, keep))
            while waiting:
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in done:
                    yield from future.result()
        except BrokenExecutor as error:
            raise ManipError("a rollout worker died (out of memory?); finished episodes are kept") from error
        finally:
            for future in waiting:
                future.cancel()

    def __enter__(self) -> Engine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=kind is None, cancel_futures=True)
            self._pool = None

    def _start(self) -> ProcessPoolExecutor:
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.workers, mp_context=context, initializer=_quiet)
        return self._pool


def default_workers() -> int:
    """As many as this process may use cores."""
    return len(os.sched_getaffinity(0))


def _chunks(seeds: Sequence[int], workers: int) -> list[Sequence[int]]:
    """Pieces of about one lockstep batch, smaller where that leaves a worker idle."""
    size = max(1, min(LOCKSTEP, -(-len(seeds) // workers)))
    return [seeds[i : i + size] for i in range(0, len(seeds), size)]


def _run(job: RolloutJob, seeds: Sequence[int], keep: Keep | None) -> Iterator[Episode]:
    for episode in run_job(job, seeds):
        if keep is not None:
            keep(episode)
        yield episode


def _run_chunk(job: RolloutJob, seeds: Sequence[int], keep: Keep | None) -> list[Episode]:
    return list(_run(job, seeds, keep))


def _quiet() -> None:
    """Workers leave Ctrl-C to the process that started them, and one core each to its neighbours."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = "1"  # read by torch, which a worker imports later
