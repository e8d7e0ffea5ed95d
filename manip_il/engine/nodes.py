"""Which nodes of a Ray cluster can work: those with a CPU and this version of the program. Nodes may come and go."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import Any

import ray
from ray import exceptions
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from manip_il import __version__
from manip_il.errors import ManipError

_LOG = logging.getLogger(__name__)
_LOOK_EVERY = 2.0  # for nodes that have come or gone [s]
_PATIENCE = 60.0  # within which a node must answer [s]
_NODE_ID = "ray.io/node-id"  # the label by which Ray knows a node


@dataclass
class _Node:
    """A node that was asked. answer: Ray's reference; wrong: what is, empty for nothing, None until it answers."""

    place: str
    answer: Any
    asked: float
    wrong: str | None = None


class Nodes:
    """Nodes of the cluster that this process is connected to.

    Raises `ManipError` where none can work. One that cannot is named in a warning.
    """

    def __init__(self) -> None:
        self._known: dict[str, _Node] = {}  # by id
        self._cores: dict[str, int] = {}  # of those that are alive, by id
        self._looked = 0.0
        self._look()
        self._hear()

    @property
    def cores(self) -> int:
        """CPUs of the nodes that can work now."""
        if time.monotonic() > self._looked + _LOOK_EVERY:
            self._look()
            self._hear()
        return sum(self._cores[node] for node in self._fit())

    def selector(self) -> dict[str, str]:
        """Return Ray's `label_selector` of the nodes that can work."""
        return {_NODE_ID: f"in({','.join(self._fit())})"}

    def _fit(self) -> list[str]:
        return [node for node in self._cores if self._known[node].wrong == ""]

    def _look(self) -> None:
        """Ask nodes that are new for their version."""
        self._looked = time.monotonic()
        alive = {node["NodeID"]: node for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) >= 1}
        if not alive:
            raise ManipError("the Ray cluster has no node with a CPU")
        self._cores = {node: int(about["Resources"]["CPU"]) for node, about in alive.items()}
        for node in alive.keys() - self._known.keys():
            place = f"node {alive[node]['NodeManagerHostname']} ({alive[node]['NodeManagerAddress']}, {node[:8]})"
            self._known[node] = _Node(place, _ask(node), self._looked)

    def _hear(self) -> None:
        """Take the answers that are there; waits for them where no node can work yet, and raises if none can then."""
        there = [self._known[node] for node in self._cores]
        if not self._fit():
            answers = [node.answer for node in there]
            ray.wait(answers, num_returns=len(answers), timeout=_PATIENCE)
        for node in there:
            if node.wrong is None:
                node.wrong = _wrong(node)
                if node.wrong:
                    _LOG.warning("%s %s; it gets no work", node.place, node.wrong)
        if not self._fit():
            found = "; ".join(f"{node.place} {node.wrong}" for node in there)
            raise ManipError(f"no node of the Ray cluster can work: {found}; install manip_il {__version__} there")


def _ask(node: str) -> Any:
    """Ask a node for its version, by a function in a function, which travels whole to where the program may lack."""

    def version() -> str:
        try:
            from manip_il import __version__ as found
        except ImportError:
            return ""
        return found

    there = NodeAffinitySchedulingStrategy(node, soft=False)
    return ray.remote(num_cpus=0, max_retries=0)(version).options(scheduling_strategy=there).remote()


def _wrong(node: _Node) -> str | None:
    """Return what is wrong with a node, empty for nothing, None while it may still answer."""
    ready, _ = ray.wait([node.answer], timeout=0)
    if not ready:
        return None if time.monotonic() < node.asked + _PATIENCE else f"has not answered in {_PATIENCE:g} s"
    try:
        version = str(ray.get(node.answer))
    except exceptions.RayError as error:
        return f"does not answer ({type(error).__name__})"
    if version == __version__:
        return ""
    return f"has manip_il {version}, not {__version__}" if version else "has no manip_il"
