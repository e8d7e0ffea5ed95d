"""A worker, whatever it is doing, ends with the process that started it, and Ctrl-C is not for it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time

import pytest

from manip_il.child_processes import map_in_order
from manip_il.errors import ManipError

from .faults.child import living

PATIENCE = 120.0  # [s]
BUSY = """
import os, time

def count(folder):
    open(f"{folder}/{os.getpid()}", "w").close()
    while True:
        sum(range(1_000_000))
"""
PROGRAM = """
import sys, time
from manip_il.child_processes import open_pool
if __name__ == "__main__":
    import busy
    open_pool(1).submit(busy.count, sys.argv[1])
    time.sleep(3600)
"""


@pytest.mark.slow
def test_a_busy_worker_ignores_ctrl_c_and_ends_with_its_parent(tmp_path):
    seen = tmp_path / "seen"
    seen.mkdir()
    (tmp_path / "busy.py").write_text(BUSY)
    (tmp_path / "program.py").write_text(PROGRAM)
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    words = [sys.executable, str(tmp_path / "program.py"), str(seen)]
    parent = subprocess.Popen(words, env=environment, start_new_session=True)
    try:
        [child] = wait_for(lambda: [int(path.name) for path in seen.iterdir()])
        os.kill(child, signal.SIGINT)
        time.sleep(0.5)
        assert child in living(parent.pid)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        wait_for(lambda: child not in living(parent.pid))
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(parent.pid, signal.SIGKILL)


@pytest.mark.slow
def test_results_come_in_the_order_of_the_items_and_a_death_is_told():
    assert (
        list(map_in_order(abs, [-3, 2, -1], 2)) == list(map_in_order(abs, [-3, 2, -1], 1)) == [(-3, 3), (2, 2), (-1, 1)]
    )
    with pytest.raises(ManipError, match="a worker died"):
        list(map_in_order(os._exit, [1], 2))


def wait_for(what):
    """What it gives, once it gives something."""
    ends = time.monotonic() + PATIENCE
    while not (found := what()):
        assert time.monotonic() < ends
        time.sleep(0.02)
    return found
