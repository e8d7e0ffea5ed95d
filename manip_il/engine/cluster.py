"""Workers of a Ray cluster: of `RAY_ADDRESS` or one that runs on this machine, else a local one that is started.

They send what is to be stored to this process, and get the policy's files from it, once a node: nodes need no shared
disk. `nodes.py` says which nodes get work.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import zstandard

from manip_il.data.atomic import new_folder
from manip_il.engine.pool import Message, Task, portable, run_task
from manip_il.errors import FolderExistsError, ManipError

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read when ray is imported
try:
    import ray
    from ray import exceptions

    from manip_il.engine.nodes import Nodes
except ImportError as missing:
    raise ManipError("--engine=ray needs Ray: pip install 'manip_il[ray]'") from missing

_DIED = (
    exceptions.WorkerCrashedError,
    exceptions.NodeDiedError,
    exceptions.ObjectLostError,
    exceptions.OutOfMemoryError,
)
_LEVEL = 1  # of compression; what is below 100 kB then goes by Ray's short way, past its object stores
Files = dict[str, bytes]


class RayCluster:
    """Up to `workers` tasks at once, one core each; by default as many as the cluster has cores.

    Raises `ManipError` where there is no cluster, or no node with this version of the program.
    """

    def __init__(self, workers: int | None):
        self._running: dict[Any, Task] = {}  # Ray's generator of a task's answers -> the task
        self._folders: dict[Path, Any] = {}  # folder -> its files in Ray's store
        self._ours = not ray.is_initialized()
        if self._ours:
            try:
                ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
            except (ConnectionError, RuntimeError, ValueError) as error:
                raise ManipError(f"no Ray cluster: {error}; check RAY_ADDRESS, or unset it for a local one") from error
        self._most, self._nodes = workers, Nodes()

    @property
    def workers(self) -> int:
        """Tasks that run at once."""
        return self._most or self._nodes.cores

    def has_room(self) -> bool:
        """Return whether fewer tasks run than may."""
        return len(self._running) < self.workers

    def submit(self, task: Task) -> None:
        """Send a task to the cluster."""
        # Deaths are counted by the engine, which knows which seeds had ended: Ray itself is to try once.
        remote = _run_remote.options(num_returns="streaming", max_retries=0, label_selector=self._nodes.selector())
        self._running[remote.remote(task, self._ship(task.job.files))] = task

    def wait(self) -> list[tuple[Task, Message]]:
        """Return one message of every task that has one."""
        ready, _ = ray.wait(list(self._running), num_returns=1, fetch_local=False)
        return [self._next(answers) for answers in ready]

    def close(self, in_order: bool) -> None:
        """Cancel what runs; a cluster that was started here ends."""
        for answers in self._running:
            ray.cancel(answers, force=True)
        self._running.clear()
        self._folders.clear()
        if self._ours and ray.is_initialized():
            ray.shutdown()

    def _next(self, answers: Any) -> tuple[Task, Message]:
        try:
            message = cast(Message, pickle.loads(zstandard.decompress(cast(bytes, ray.get(next(answers))))))
        except _DIED as death:
            message = Message("died", error=death)
        except exceptions.RayError as failure:  # what the task itself raises comes as a message
            message = Message("failed", error=portable(failure))
        task = self._running[answers]
        if message.kind != "episode":
            del self._running[answers]
        return task, message

    def _ship(self, folder: Path | None) -> Any:
        if folder is None:
            return None
        if folder not in self._folders:
            files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*.*"))}
            self._folders[folder] = ray.put(files)
        return self._folders[folder]


@ray.remote(num_cpus=1)
def _run_remote(task: Task, files: Files | None) -> Iterator[bytes]:
    def unpacked() -> Task:
        return task if files is None else replace(task, job=task.job.with_files(_unpack(files)))

    for message in run_task(unpacked, store=False):
        yield pack_message(message)


def pack_message(message: Message) -> bytes:
    """Return what goes over the wire."""
    return zstandard.compress(pickle.dumps(message, pickle.HIGHEST_PROTOCOL), _LEVEL)


def _unpack(files: Files) -> Path:
    """The policy's folder on this node, written once for all tasks that bring the same files."""
    content = hashlib.sha256()
    for name, data in sorted(files.items()):
        content.update(name.encode() + b"\0" + hashlib.sha256(data).digest())
    folder = Path(tempfile.gettempdir()) / f"manip_il-policy-{os.getuid()}-{content.hexdigest()[:32]}"
    if folder.is_dir():
        return folder
    try:
        with new_folder(folder) as new:
            for name, data in files.items():
                (new / name).parent.mkdir(parents=True, exist_ok=True)
                (new / name).write_bytes(data)
    except FolderExistsError:  # another task on this node was faster
        pass
    return folder
