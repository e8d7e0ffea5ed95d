"""Settings for every test."""

import contextlib
import ctypes
import functools
import gc
import logging
import multiprocessing
import os
import resource
import sys
from collections.abc import Callable, Iterator
from multiprocessing import forkserver
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from manip_il.progress import Progress

from .faults.child import run_command
from .warm import Warm

# The same examples in every run, so that a change that passes here passes elsewhere. How long an
# example takes says something about the machine, nothing about the program.
settings.register_profile(
    "manip_il", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("manip_il")

# Rollout workers, and commands that are to be killed, are forked from one server a process, and
# what it imports when it starts decides for all: without this the first test to need it decides,
# and every later worker that drives a policy imports torch and LeRobot anew, six seconds each.
IMPORTED_ONCE = [
    "manip_il.cli.imitation",
    "manip_il.cli.evaluate",
    "manip_il.algorithms.run",
    "manip_il.collect.record",
    "manip_il.collect.job",
    "manip_il.evaluation.eval_report",
    "manip_il.learn.policy",
    "manip_il.learn.train",
    "manip_il.bridges.store.transfer",
    "lerobot.policies.act.modeling_act",
    "pyarrow.parquet",
]
forkserver.set_forkserver_preload(IMPORTED_ONCE)
forkserver.set_forkserver_preload = lambda modules_names: None  # pyright: ignore[reportAttributeAccessIssue]


def watching(**methods: Callable[..., object]) -> Progress:
    """Return a progress with these methods."""
    progress = Progress()
    vars(progress).update(methods)
    return progress


LARGE = 1_000_000_000  # of a process [bytes]
_TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's

# The files that take longest (`pytest --durations=0`), longest first: begun late, one of them is
# what all wait for.
LONG = (
    "docs/test_commands.py",
    "course/test_notebooks.py",
    "evaluation/test_certificate.py",
    "store/test_kills.py",
    "lerobot_commands/test_policies.py",
    "store/test_push_pull.py",
    "doctor/test_planted.py",
    "cli/test_commands.py",
    "faults/test_kills.py",
    "collect/test_workers.py",
    "lerobot_commands/test_pictures.py",
    "evaluation/test_runner.py",
    "learn/test_train.py",
)


@pytest.fixture(autouse=True)
def _ordinary_scheduling() -> Iterator[None]:
    """Take back the real-time priority that LeRobot's encoder, run by root, gives to this
    process for good.
    """
    _take_back()
    yield
    _take_back()


def _take_back() -> None:
    for thread in os.listdir("/proc/self/task") if sys.platform == "linux" else ():
        with contextlib.suppress(OSError):  # it has ended
            if os.sched_getscheduler(int(thread)) != os.SCHED_OTHER:
                os.sched_setscheduler(int(thread), os.SCHED_OTHER, os.sched_param(0))


@pytest.fixture(scope="module", autouse=True)
def _caches_are_freed(request: pytest.FixtureRequest) -> Iterator[None]:
    """Free what a file keeps for its own tests after them.

    Caches of the package and of MuJoCo are kept for the next file unless this process has grown
    large.
    """
    from manip_il.caching import PerThread

    yield
    large = _resident() > LARGE
    modules = [
        module for name, module in sys.modules.items() if large and name.startswith("manip_il.")
    ]
    for kept in [one for module in (request.module, *modules) for one in vars(module).values()]:
        cache = kept.own if isinstance(kept, PerThread) else kept
        if isinstance(cache, functools._lru_cache_wrapper):
            cache.cache_clear()
    if large:
        import mujoco  # imported here: manip_il chooses its OpenGL platform first

        mujoco.mj_clearCache(mujoco.mj_getCache())  # of compiled meshes
        gc.collect()


@pytest.fixture(autouse=True)
def _allocator_gives_back() -> Iterator[None]:
    """Give back what the allocator holds of freed memory: glibc keeps all of it once a large
    model was freed.
    """
    yield
    if _TRIM is not None and _resident() > LARGE:
        _TRIM(0)


def _resident() -> int:
    """This process's memory [bytes]; 0 where no file says it."""
    said = Path("/proc/self/statm")
    return int(said.read_text().split()[1]) * resource.getpagesize() if said.is_file() else 0


def pytest_collection_finish() -> None:
    """What test files have imported is never garbage: do not search it again and again."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files come first, everything else as it was."""
    here = Path(__file__).parent
    places = {here / name: place for place, name in enumerate(LONG)}
    items.sort(key=lambda item: places.get(item.path, len(places)))


@pytest.fixture(autouse=True)
def _logging_as_before() -> Iterator[None]:
    """LeRobot's commands set the root logger up, with a handler of the test's own standard
    error.
    """
    root = logging.getLogger()
    level, handlers = root.level, list(root.handlers)
    yield
    root.setLevel(level)
    for handler in [one for one in root.handlers if one not in handlers]:
        root.removeHandler(handler)


@pytest.fixture(scope="session")
def start() -> Callable[..., ForkServerProcess]:
    """Starts a command in a process of its own within milliseconds: what it imports is loaded
    once.
    """
    context = multiprocessing.get_context("forkserver")

    def begin(
        *words: str, log: Path, warm: bool = False, largest_file: int = 0
    ) -> ForkServerProcess:
        process = context.Process(target=run_command, args=(words, str(log), warm, largest_file))
        process.start()
        return process

    return begin


@pytest.fixture(scope="module")  # it takes half a gigabyte
def warm_lerobot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Warm]:
    """Runs LeRobot's commands, and scripts that use it, without network and with a home of its
    own.
    """
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "CUDA_VISIBLE_DEVICES": "", "SVT_LOG": "1"}
    with Warm(environment, tmp_path_factory.mktemp("home")) as warm:
        yield warm
