"""Workers of a Ray cluster: of `RAY_ADDRESS` or one that runs on this machine, else a local one that is started.

They send what is to be stored to this process, and get the policy's files from it, once a node: nodes need no shared
disk.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import tempfile
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import zstandard

from manip_il import __version__
from manip_il.collect.task import Answer, Job, Seeds, run_seeds
from manip_il.data.atomic import new_folder
from manip_il.data.journal import Journal
from manip_il.errors import FolderExistsError, ManipError

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read when ray is imported
try:
    import ray
    from ray import exceptions
except ImportError as missing:
    raise ManipError("--engine=ray needs Ray: pip install 'manip_il[ray]'") from missing

_LEVEL = 1  # of compression; what is below 100 kB then goes by Ray's short way, past its object stores
Files = dict[str, bytes]


class RayCluster:
    """Up to `workers` tasks at once, one core each; by default as many as the cluster has cores now.

    Raises `ManipError` if there is no cluster.
    """

    died = (
        exceptions.WorkerCrashedError,
        exceptions.NodeDiedError,
        exceptions.ObjectLostError,
        exceptions.OutOfMemoryError,
    )

    def __init__(self, workers: int | None):
        self._running: dict[Future[Answer], Any] = {}  # with Ray's reference of each
        self._folders: dict[Path, Any] = {}  # folder -> its files in Ray's store
        self._most, self._ours = workers, not ray.is_initialized()
        if self._ours:
            try:
                ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
            except (ConnectionError, RuntimeError, ValueError) as error:
                raise ManipError(f"no Ray cluster: {error}; check RAY_ADDRESS, or unset it for a local one") from error

    @property
    def count(self) -> int:
        """Tasks that run at once; more if nodes have come."""
        return self._most or max(1, int(ray.cluster_resources().get("CPU", 1)))

    def submit(self, job: Job, seeds: Seeds, journal: Journal | None) -> Future[Answer]:
        """Send some seeds of a job to the cluster."""
        reference = _run_remote.remote(__version__, job, self._ship(job.files), seeds, journal)
        future: Future[Answer] = Future()
        self._running[future] = reference
        reference.future().add_done_callback(lambda answer: self._settle(future, answer))
        return future

    def close(self, in_order: bool) -> None:
        """Cancel what runs; a cluster that was started here ends."""
        for reference in list(self._running.values()):
            ray.cancel(reference, force=True)
        self._running.clear()
        self._folders.clear()
        if self._ours and ray.is_initialized():
            ray.shutdown()

    def _settle(self, future: Future[Answer], answer: Future[bytes]) -> None:
        self._running.pop(future, None)
        try:
            future.set_result(pickle.loads(zstandard.decompress(answer.result())))
        except exceptions.RayTaskError as failure:
            cause = failure.cause
            future.set_exception(cause if isinstance(cause, ManipError) else ManipError(str(failure).splitlines()[-1]))
        except Exception as error:
            future.set_exception(error if isinstance(error, self.died) else ManipError(f"Ray: {error}"))

    def _ship(self, folder: Path | None) -> Any:
        if folder is None:
            return None
        if folder not in self._folders:
            files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*.*"))}
            self._folders[folder] = ray.put(files)
        return self._folders[folder]


def run_there(version: str, job: Job, files: Files | None, seeds: Seeds, journal: Journal | None) -> bytes:
    """Return the packed answer of a task on a node. Raises `ManipError` if it has another version of the program."""
    if version != __version__:
        node = ray.util.get_node_ip_address()
        raise ManipError(f"the Ray node {node} has manip_il {__version__}, not {version}; install {version} there")
    return packed(run_seeds(job if files is None else job.with_files(_unpack(files)), seeds, journal, store=False))


# Deaths are counted by the engine: Ray itself is to try once. Its function keeps a name of its own, so that what is
# sent is the name and a node runs the function that it has, else the version would be this process's everywhere.
_run_remote = ray.remote(num_cpus=1, max_retries=0)(run_there)


def packed(answer: Answer) -> bytes:
    """Return what goes over the wire."""
    return zstandard.compress(pickle.dumps(answer, pickle.HIGHEST_PROTOCOL), _LEVEL)


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
