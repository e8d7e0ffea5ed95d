"""Processes on this machine, one task at a time each; one that dies is replaced."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
from collections.abc import Generator, Iterator
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait

from manip_il.child_processes import bound_to_this_process, watch_parent
from manip_il.engine.engine import Event, Task, portable, run_task
from manip_il.mdp import Episode

# Workers are forked from a server that has imported what they need, and nothing else: neither OpenGL nor threads are
# shared, and the import of torch, seconds of work, is paid once and not by every worker.
_CONTEXT = multiprocessing.get_context("forkserver")
_EVERY_JOB, _LEARNED_JOB = ("manip_il.engine.jobs",), ("manip_il.engine.jobs", "manip_il.learn.policy")
_PATIENCE = 10.0  # for a worker that was told to stop [s]


def start_server(learned: bool) -> None:
    """Start what workers are forked from, beside whatever this process does meanwhile; once a process.

    learned: whether policies will drive. The server has the environment variables of this moment.
    """
    _CONTEXT.set_forkserver_preload(list(_LEARNED_JOB if learned else _EVERY_JOB))
    threads = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"  # read when torch is imported; one core each
    try:
        with _without_interrupts(), bound_to_this_process():
            resource_tracker.ensure_running()  # first, as its own start would undo the mask
            forkserver.ensure_running()
    finally:
        if threads is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = threads


@contextlib.contextmanager
def _without_interrupts() -> Generator[None]:
    """Processes that are started meanwhile do not hear Ctrl-C, which is not for workers."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


class LocalProcesses:
    """Up to `workers` processes, started as tasks come."""

    def __init__(self, workers: int):
        self.workers = workers
        self._idle: list[_Worker] = []
        self._busy: dict[Connection, _Worker] = {}

    def has_room(self) -> bool:
        """Return whether a worker is free or may be started."""
        return len(self._busy) < self.workers

    def submit(self, task: Task) -> None:
        """Hand a task to a worker."""
        start_server(learned=task.job.policy is not None)
        worker = self._idle.pop() if self._idle else _Worker()
        self._busy[worker.connection] = worker
        worker.start(task)

    def wait(self) -> list[Event]:
        """Return one event of every worker that has something to say."""
        events: list[Event] = []
        for ready in wait(list(self._busy)):
            assert isinstance(ready, Connection)
            event = self._busy[ready].receive()
            events.append(event)
            if event.kind != "episode":
                worker = self._busy.pop(ready)
                if event.kind != "died":
                    self._idle.append(worker)
        return events

    def close(self, in_order: bool) -> None:
        """End all workers."""
        workers = [*self._idle, *self._busy.values()]
        for worker in workers:
            worker.stop(in_order)
        for worker in workers:
            worker.join()
        self._idle.clear()
        self._busy.clear()


class _Worker:
    def __init__(self) -> None:
        self.connection, theirs = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(target=_serve, args=(theirs,), daemon=True)
        with _without_interrupts():
            self._process.start()
        theirs.close()  # so that the pipe ends when the worker does
        self._task: Task | None = None

    def start(self, task: Task) -> None:
        self._task = task
        with contextlib.suppress(OSError):  # a worker that died meanwhile is found by `receive`
            self.connection.send_bytes(pickle.dumps(task))

    def receive(self) -> Event:
        assert self._task is not None
        try:
            kind, episode, error = self.connection.recv()
        except (EOFError, OSError):
            self._process.join()
            self.connection.close()
            return Event(self._task, "died", error=RuntimeError(_cause(self._process.exitcode)))
        return Event(self._task, kind, episode, error=error)

    def stop(self, in_order: bool) -> None:
        if not in_order:
            self._process.kill()
        self.connection.close()

    def join(self) -> None:
        self._process.join(_PATIENCE)
        self._process.kill()
        self._process.join()


def _serve(connection: Connection) -> None:
    """A worker's life: tasks in, episodes out, until the other end goes away."""
    watch_parent()
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            for message in _answer(connection.recv_bytes()):
                connection.send(message)


def _answer(pickled: bytes) -> Iterator[tuple[str, Episode | None, Exception | None]]:
    try:
        task: Task = pickle.loads(pickled)  # from the process that started this one
        for episode, packed in run_task(task):
            if task.keep is not None:
                task.keep.store(episode.seed, packed)
            yield "episode", episode, None
        yield "done", None, None
    except Exception as error:
        yield "failed", None, portable(error)


def _cause(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return f"killed by {signal.Signals(-exit_code).name}; out of memory?"
    return f"exit code {exit_code}"
