"""What runs in the children of tests."""

import gc
import os
import resource
import sys
from collections.abc import Sequence
from multiprocessing import util
from typing import Any


def run_command(words: Sequence[str], log: str, warm: bool, largest_file: int) -> None:
    """In a child: one command, as from a shell, in a session of its own, with all that it says in
    the file `log`.

    warm: what its workers are forked from has loaded everything, as this process has. largest_file:
    how large a file may get [bytes], 0 for any size; the kernel then refuses to write as it does
    when a disk is full.
    """
    from manip_il.cli.main import main

    gc.freeze()  # else the first collection copies all that is shared with the parent
    os.setsid()
    say_into(log)
    if warm:
        fork_instead_of_spawning()
    if largest_file:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
    sys.exit(main(words))


def say_into(log: str) -> None:
    """Put what this process prints into a file."""
    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(handle, 1)
    os.dup2(handle, 2)


def fork_instead_of_spawning() -> None:
    """Have the workers of this process forked from it, with all that it has imported."""
    util.spawnv_passfds = _fork_what_would_be_spawned  # pyright: ignore


def living(session: int) -> list[int]:
    """Processes of a session, without those that only wait for their parent to look at how they
    ended.
    """
    return [
        int(pid) for pid in os.listdir("/proc") if pid.isdecimal() and _is_alive_in(pid, session)
    ]


def _is_alive_in(pid: str, session: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            state, _, _, its_session, *_ = file.read().rpartition(")")[2].split()
    except OSError:
        return False
    return int(its_session) == session and state not in "ZX"


def _fork_what_would_be_spawned(path: bytes, words: Sequence[Any], handles: Sequence[int]) -> int:
    """`multiprocessing.util.spawnv_passfds` for a `python -c CODE` whose imports are done:
    seconds are saved.
    """
    pid = os.fork()
    if pid:
        return pid
    try:
        low = 3
        for handle in (*sorted(handles), os.sysconf("SC_OPEN_MAX")):
            os.closerange(low, handle)
            low = handle + 1
        exec(words[-1], {})
    finally:
        os._exit(0)
