"""Child processes that end with the process that started them, also where that was killed.

Linux sends them SIGKILL in that moment (`PR_SET_PDEATHSIG`), whatever they are doing; elsewhere, and where a thread
other than the main one started them, they find the end of a pipe, as soon as Python runs another thread.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Generator

_VARIABLE = "MANIP_IL_PARENT"  # process id; for the children that are started meanwhile
_PDEATHSIG = 1  # PR_SET_PDEATHSIG
_forking = 0  # process id, where the main thread is forking


@contextlib.contextmanager
def bound_to_this_process() -> Generator[None]:
    """Start Python processes inside that end with this one, from the moment that they import `manip_il`."""
    if threading.current_thread() is not threading.main_thread():  # Linux would kill them when this thread ends
        yield
        return
    os.environ[_VARIABLE] = str(os.getpid())
    try:
        yield
    finally:
        del os.environ[_VARIABLE]


def obey_parent() -> None:
    """End with the parent where it started this process in `bound_to_this_process`; processes forked here do too."""
    parent = os.environ.pop(_VARIABLE, None)
    if parent is not None:
        _end_with(int(parent))
        os.register_at_fork(before=_before_fork, after_in_child=_after_fork)


def watch_parent() -> None:
    """End this process, a child of `multiprocessing`, at the end of the pipe from the one that started it."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def initialize_worker() -> None:
    """Begin a pool's process: it ignores Ctrl-C, which the process that started it handles, and ends with that one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    watch_parent()


def _end_with(parent: int) -> None:
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it was gone already
        os._exit(1)


def _before_fork() -> None:
    global _forking
    _forking = os.getpid() if threading.current_thread() is threading.main_thread() else 0


def _after_fork() -> None:
    if _forking:
        _end_with(_forking)


def _wait_for_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)
