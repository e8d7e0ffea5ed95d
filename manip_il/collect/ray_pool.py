"""Workers of a Ray cluster: the one at `RAY_ADDRESS` or running on this machine, else a new local
one.

Workers return episodes to this process, which stores them. Nodes need no shared disk: policies and
files of a user's own task and mesh are sent to them, once per node.
"""

import logging
import os
import pickle
import tempfile
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import zstandard

from manip_il import __version__
from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.data.journal import Journal
from manip_il.errors import ManipError, requires
from manip_il.mdp import Episode
from manip_il.sim.mesh import mesh_path

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read when ray is imported
with requires("--engine=ray", "'manip_il[ray]'"):
    import ray

Files = dict[str, bytes]
_RETRIES = 3  # of a task whose worker or node died
_LEVEL = 1  # compression level; reduces an episode without pictures to a fifth


class RayPool:
    """Runs several tasks at once on a Ray cluster, with one core for each.

    Args:
        workers: Largest number of concurrent tasks; None for one per core of the cluster.

    Raises:
        ManipError: if no cluster can be reached or started.
    """

    def __init__(self, workers: int | None):
        self._running: dict[Future[list[Episode]], Any] = {}  # future -> Ray's reference
        self._folders: dict[Path, Any] = {}  # folder -> its files in Ray's store
        self._most, self._ours = workers, not ray.is_initialized()
        if self._ours:
            try:
                ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
            except (ConnectionError, RuntimeError, ValueError) as error:
                raise ManipError(
                    f"no Ray cluster: {error}; check RAY_ADDRESS, or unset it for a local one"
                ) from error

    @property
    def count(self) -> int:
        """Number of tasks that can run at once; grows with the cluster."""
        return self._most or max(1, int(ray.cluster_resources().get("CPU", 1)))

    def submit(
        self, job: RolloutJob, seeds: tuple[int, ...], journal: Journal | None
    ) -> Future[list[Episode]]:
        """Submit some seeds of a job to the cluster.

        Args:
            job: The job, with paths on this machine.
            seeds: One for each episode of the task.
            journal: Where this process stores returned episodes; None to store none.

        Returns:
            The future of the episodes, which come without pictures.
        """
        files = [self._upload(policy.path) for policy in job.driver.policies]
        world, task = (
            self._upload(one) if isinstance(one, Path) and one.suffix == ".py" else None
            for one in (job.env.robot, job.env.task)
        )
        mesh = self._upload(path) if (path := mesh_path(job.env.object)) else None
        reference = _run_remote.remote(__version__, job, seeds, journal, world, task, mesh, *files)
        future: Future[list[Episode]] = Future()
        self._running[future] = reference
        reference.future().add_done_callback(lambda answer: self._settle(future, answer, journal))
        return future

    def close(self) -> None:
        """Cancel running tasks, and shut down a cluster that was started here."""
        for reference in list(self._running.values()):
            ray.cancel(reference, force=True)
        self._running.clear()
        self._folders.clear()
        if self._ours and ray.is_initialized():
            ray.shutdown()

    def _settle(
        self, future: Future[list[Episode]], answer: Future[bytes], journal: Journal | None
    ) -> None:
        """Store returned episodes, and set the future's result or error."""
        self._running.pop(future, None)
        try:
            found: list[tuple[Episode, bytes]] = pickle.loads(zstandard.decompress(answer.result()))
            for episode, content in found:
                if journal is not None:
                    journal.store(episode.seed, content)
            future.set_result([episode for episode, _ in found])
        except ManipError as error:
            future.set_exception(getattr(error, "cause", error))  # the error raised on the node
        except Exception as error:
            future.set_exception(ManipError(f"Ray: {(str(error) or repr(error)).splitlines()[-1]}"))

    def _upload(self, folder: Path) -> Any:
        if folder not in self._folders:
            root, paths = (
                (folder.parent, [folder])
                if folder.is_file()
                else (folder, sorted(folder.rglob("*.*")))
            )
            self._folders[folder] = ray.put(
                {path.relative_to(root).as_posix(): path.read_bytes() for path in paths}
            )
        return self._folders[folder]


def run_there(
    version: str,
    job: RolloutJob,
    seeds: tuple[int, ...],
    journal: Journal | None,
    world: Files | None,
    task: Files | None,
    mesh: Files | None,
    *policies: Files,
) -> bytes:
    """Run seeds on a node, and return the packed episodes and journals.

    Args:
        version: Version of manip_il on the machine that submitted the job.
        job: The job, with paths on that machine.
        seeds: One for each episode.
        journal: Encodes the episodes; None for no journals.
        world: Content of the file of the user's own world, by its name; None if it has none.
        task: The same for the user's own task.
        mesh: The same for the mesh of the object.
        policies: The same for the folder of each of the driver's policies.

    Returns:
        The pickled and compressed list of episodes, without pictures, each with its journal as
        bytes.

    Raises:
        ManipError: if the node runs another version.
    """
    if version != __version__:
        node = ray.util.get_node_ip_address()
        raise ManipError(
            f"the Ray node {node} has manip_il {__version__}, not {version}; install {version}"
            " there"
        )
    with tempfile.TemporaryDirectory(prefix="manip_il-") as folder:
        for field, files in (("robot", world), ("task", task)):
            if files is not None:
                file = _unpack(files, Path(folder) / field) / Path(getattr(job.env, field)).name
                job = replace(job, env=replace(job.env, **{field: file}))
        if mesh is not None:
            name = Path(str(job.env.object).removeprefix("mesh:")).name  # with the length
            at = _unpack(mesh, Path(folder) / "mesh") / name
            job = replace(job, env=replace(job.env, object=Path(f"mesh:{at}")))
        if isinstance(job.driver, PolicyDriver):
            here = (
                _unpack(files, Path(folder) / str(number)) for number, files in enumerate(policies)
            )
            moved = tuple(map(lambda one, path: replace(one, path=path), job.driver.policies, here))
            job = replace(job, driver=replace(job.driver, policies=moved))
        found = [
            (one.without_pictures(), journal.encode(one) if journal else b"")
            for one in job.run(seeds)
        ]
        return zstandard.compress(pickle.dumps(found), _LEVEL)


# Ray runs a task again if its worker or node dies. The remote function has another name than
# `run_there`, so that Ray pickles `run_there` by name. So each node runs the `run_there` of its own
# version, which compares the versions.
_run_remote = ray.remote(num_cpus=1, max_retries=_RETRIES)(run_there)


def _unpack(files: Files, folder: Path) -> Path:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder
