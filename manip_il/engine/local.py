"""Worker processes on this machine, one task at a time each, and whether memory suffices for them."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import pickle
import signal
from collections.abc import Generator, Iterator
from functools import partial
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path

from manip_il.child_processes import bound_to_this_process, watch_parent
from manip_il.engine.pool import Message, Task, run_task
from manip_il.errors import ManipError

# Workers are forked from a server that has imported what they need, and nothing else: neither OpenGL nor threads are
# shared, and the import of torch, seconds of work, is paid once and not by every worker.
_CONTEXT = multiprocessing.get_context("forkserver")
_EVERY_JOB, _LEARNED_JOB = ("manip_il.engine.jobs",), ("manip_il.engine.jobs", "manip_il.learn.policy")
_TIMEOUT = 10.0  # for a worker that is to stop [s]

# Measured as the peak of anonymous memory of a container's control group, over 20 to 50 episodes of Panda pick_place:
# 244 MB the expert, 556 MB an mlp, 861 MB a cnn with two cameras, each with one worker; with two, 1,459 MB an mlp and
# 2,391 MB a cnn, as the command's own process is then one more. An mlp ran in 580 MB and was killed in 500, a cnn ran
# in 900 MB and was killed in 700. An act with 161 MB of weights took 345 MB more than the cnn.
PROC, CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")
_MB, _GB = 1_000_000, 1_000_000_000
_PROCESS = 260 * _MB  # simulator, expert, Python
_LEARNED = 320 * _MB  # torch and a small network
_CAMERAS = 300 * _MB  # OpenGL, LeRobot's code around a network of pictures
# Once, whatever the number of workers: films and report (127 MB), and a health check that comes in between (310 MB).
_BESIDE = 450 * _MB


def start_server(learned: bool) -> None:
    """Start the server that workers are forked from, in the background; once a process.

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
    """Processes that are started meanwhile ignore Ctrl-C."""
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
        """Send a task to a worker."""
        start_server(learned=task.job.learned)
        worker = self._idle.pop() if self._idle else _Worker()
        self._busy[worker.connection] = worker
        worker.start(task)

    def wait(self) -> list[tuple[Task, Message]]:
        """Return one message of every worker that has one."""
        messages: list[tuple[Task, Message]] = []
        for ready in wait(list(self._busy)):
            assert isinstance(ready, Connection)
            worker = self._busy[ready]
            task, message = worker.receive()
            messages.append((task, message))
            if message.kind != "episode":
                del self._busy[ready]
                if message.kind != "died":
                    self._idle.append(worker)
        return messages

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

    def receive(self) -> tuple[Task, Message]:
        assert self._task is not None
        try:
            return self._task, self.connection.recv()
        except (EOFError, OSError):
            self._process.join()
            self.connection.close()
            return self._task, Message("died", error=RuntimeError(_cause(self._process.exitcode)))

    def stop(self, in_order: bool) -> None:
        if not in_order:
            self._process.kill()
        self.connection.close()

    def join(self) -> None:
        self._process.join(_TIMEOUT)
        self._process.kill()
        self._process.join()


def _serve(connection: Connection) -> None:
    """Run tasks and send their episodes, until the other end of the connection is closed."""
    watch_parent()
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            pickled = connection.recv_bytes()  # from the process that started this one
            for message in run_task(partial(pickle.loads, pickled), store=True):
                connection.send(message)


def _cause(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return f"killed by {signal.Signals(-exit_code).name}; out of memory?"
    return f"exit code {exit_code}"


def check_memory(
    workers: int,
    cameras: bool,
    *,
    learned: bool = True,
    weights: int = 0,
    proc: Path = PROC,
    cgroups: Path = CGROUPS,
) -> None:
    """Raise `ManipError` where an evaluation in so many processes would run out of memory.

    Call it before a policy is loaded; what this process holds counts as free, as it is part of what is needed. cameras:
    whether the policy looks at pictures. learned: whether it is a network. weights: the size of its file [bytes]. Does
    nothing on a system that does not say what is free.
    """
    free, need = available_memory(proc, cgroups), needed_memory(workers, cameras, learned=learned, weights=weights)
    if free is None:
        return
    free += 1024 * _fields(proc / "self" / "status").get("RssAnon:", 0)
    if free >= need:
        return
    fitting = [n for n in range(1, workers) if needed_memory(n, cameras, learned=learned, weights=weights) <= free]
    fewer = f"use --workers={fitting[-1]}, or " if fitting else ""
    raise ManipError(
        f"too little memory: {workers} worker{'s' if workers > 1 else ''} {'with' if cameras else 'without'} cameras "
        f"need about {math.ceil(10 * need / _GB) / 10} GB, {math.floor(10 * free / _GB) / 10} GB are free; "
        f"{fewer}give it more (docker run --memory=...)"
    )


def needed_memory(workers: int, cameras: bool, *, learned: bool = True, weights: int = 0) -> int:
    """Return what an evaluation takes, with a margin [bytes]; one worker is this process, more are beside it."""
    processes = 1 if workers == 1 else workers + 1
    each = _PROCESS + (_LEARNED + 2 * weights if learned else 0) + (_CAMERAS if cameras else 0)
    return _BESIDE + processes * each


def available_memory(proc: Path = PROC, cgroups: Path = CGROUPS) -> int | None:
    """Return what this process and its children may still take [bytes]; None where the system does not say.

    The least of what the machine has free and of what each control group above this process (a container's limit)
    leaves. proc, cgroups: where those file systems are mounted.
    """
    free = [_group_memory(group) for group in _groups(proc, cgroups)]
    if (kilobytes := _fields(proc / "meminfo").get("MemAvailable:")) is not None:
        free.append(1024 * kilobytes)
    return min((one for one in free if one is not None), default=None)


def _groups(proc: Path, cgroups: Path) -> Iterator[Path]:
    """Folders of the memory control groups that hold this process, from its own up to the outermost one seen here.

    A line of `/proc/self/cgroup` is `0::/path` (version 2) or `4:memory:/path` (version 1). Within a container the
    path may be the host's, which does not exist there; the root then is the container's own group.
    """
    for line in _lines(proc / "self" / "cgroup"):
        number, controllers, path = (*line.split(":", 2), "", "")[:3]
        if number == "0":
            root = cgroups
        elif "memory" in controllers.split(","):
            root = cgroups / "memory"
        else:
            continue
        group = root / path.lstrip("/")
        while group != root:
            yield group
            group = group.parent
        yield root


def _group_memory(group: Path) -> int | None:
    """Return the memory that a control group leaves [bytes]: its limit less use; cached files do not count."""
    for limit_file, usage_file, prefix in (
        ("memory.max", "memory.current", ""),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_"),
    ):
        limit, usage = _number(group / limit_file), _number(group / usage_file)
        if limit is not None and usage is not None:
            held = _fields(group / "memory.stat")
            cached = sum(held.get(f"{prefix}{kind}_file", 0) for kind in ("active", "inactive"))
            return max(0, limit - usage + min(cached, usage))
    return None


def _number(file: Path) -> int | None:
    """The number in a file; None for `max`, and where there is no such file."""
    text = "".join(_lines(file)).strip()
    return int(text) if text.isdigit() else None


def _fields(file: Path) -> dict[str, int]:
    """Name -> number of the lines of a file that begin so."""
    words = (line.split() for line in _lines(file))
    return {pair[0]: int(pair[1]) for pair in words if len(pair) > 1 and pair[1].isdigit()}


def _lines(file: Path) -> list[str]:
    try:
        return file.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:  # another system
        return []
