"""Whatever a child process is doing, it ends with the process that started it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from manip_il import child_processes
from manip_il.child_processes import bound_to_this_process

from .faults.child import living

PATIENCE = 120.0  # [s]
BUSY = """
import os, re, sys, time

def say(folder):
    with open(f"{folder}/{os.getpid()}.tmp", "w") as file:
        pass
    os.rename(f"{folder}/{os.getpid()}.tmp", f"{folder}/{os.getpid()}")

def search(folder):
    say(folder)
    re.match("(a+)+$", 64 * "a" + "b")  # for years, in C, with no other thread getting its turn
"""
IMPORTING = "import manip_il, busy\nbusy.search({folder!r})\n"
FORK_SERVER = """
import multiprocessing, sys
from manip_il.child_processes import bound_to_this_process
context = multiprocessing.get_context("forkserver")
context.set_forkserver_preload([sys.argv[2]])
if __name__ == "__main__":
    import busy
    with bound_to_this_process():
        context.Process(target=busy.search, args=(sys.argv[1],)).start()
    import time; time.sleep(3600)
"""
POOL = """
import multiprocessing, sys
from concurrent.futures import ProcessPoolExecutor
from manip_il.child_processes import bound_to_this_process, initialize_worker
if __name__ == "__main__":
    import busy
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=initialize_worker)
    with bound_to_this_process():
        pool.submit(busy.search, sys.argv[1])
    import time; time.sleep(3600)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "preload"),
    [(FORK_SERVER, "manip_il"), (FORK_SERVER, "importing"), (POOL, "")],
    ids=["forked while it works", "fork server while it imports", "pool"],
)
def test_a_child_that_never_comes_up_for_air_ends_with_its_parent(code, preload, tmp_path):
    seen = tmp_path / "seen"
    seen.mkdir()
    (tmp_path / "busy.py").write_text(BUSY)
    (tmp_path / "importing.py").write_text(IMPORTING.format(folder=str(seen)))
    (tmp_path / "program.py").write_text(code)
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    words = [sys.executable, str(tmp_path / "program.py"), str(seen), preload]
    parent = subprocess.Popen(words, env=environment, start_new_session=True)
    try:
        [child] = wait_for(lambda: [int(path.name) for path in seen.iterdir() if path.name.isdecimal()])
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        wait_for(lambda: child not in living(parent.pid))
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(parent.pid, signal.SIGKILL)


def test_only_what_is_started_inside_is_bound():
    def environment() -> dict[str, str]:
        with bound_to_this_process():
            return dict(os.environ)

    before = dict(os.environ)
    assert environment().keys() - before.keys() == {"MANIP_IL_PARENT"}
    assert dict(os.environ) == before
    with ThreadPoolExecutor(1) as pool:  # whose children would be killed when the thread ends
        assert pool.submit(environment).result() == before


def test_a_child_whose_parent_is_gone_already_ends(tmp_path):
    code = "import manip_il; open('here', 'w')"
    environment = os.environ | {"MANIP_IL_PARENT": "1"}
    run = subprocess.run([sys.executable, "-c", code], env=environment, cwd=tmp_path, check=False, timeout=PATIENCE)
    assert run.returncode == 1
    assert list(tmp_path.iterdir()) == []


def test_another_system_has_the_pipe_alone(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(child_processes.os, "_exit", None)
    child_processes._end_with(1)


def wait_for(what):
    """What it gives, once it gives something."""
    ends = time.monotonic() + PATIENCE
    while not (found := what()):
        assert time.monotonic() < ends
        time.sleep(0.02)
    return found
