"""What a disk, a folder, another recorder or a missing OpenGL can do to a recorder: one clear line, nothing lost."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from manip_il.cli.main import main
from manip_il.data.journal import list_episodes, read_journal

from .full_disk import the_error
from .killed import contents

pytestmark = pytest.mark.slow

WORDS = ("record", "--robot.type=fetch", "--task.type=reach", "--dataset.num_episodes=4", "--workers=1")
# root writes where it likes, unless it gives that up
BOUND = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.getuid() == 0 else []


def record(root: Path, *more: str, before: Sequence[str] = (), **popen) -> subprocess.CompletedProcess[str]:
    words = [*before, sys.executable, "-m", "manip_il.cli.main", *WORDS, f"--dataset.root={root}", *more]
    return subprocess.run(words, capture_output=True, text=True, timeout=600, check=False, **popen)


def one_line(run: subprocess.CompletedProcess[str]) -> str:
    assert run.returncode == 1, run.stderr
    return the_error(run.stderr)


def small_disk(limit: int):
    """Lets files grow to `limit` bytes: the kernel then refuses as it does when a disk is full."""

    def apply() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return apply


@pytest.mark.parametrize("workers", [1, 2])
def test_a_full_disk_ends_the_recording_and_keeps_what_was_finished(tmp_path, workers):
    root, journals = tmp_path / "demos", tmp_path / "demos.journals"
    assert main([*WORDS, f"--dataset.root={root}"]) == 0
    all_of_them = contents(journals)
    sizes = sorted(map(len, all_of_them.values()))
    again = tmp_path / "again"
    run = record(again, f"--workers={workers}", preexec_fn=small_disk((sizes[0] + sizes[-1]) // 2))
    error = one_line(run)
    assert "File too large" in error
    assert "--resume=true" in error
    kept = contents(tmp_path / "again.journals")
    assert len(kept) < 4
    assert kept.items() <= all_of_them.items()
    assert not again.exists()
    assert main([*WORDS, f"--dataset.root={again}", "--resume=true"]) == 0
    assert contents(tmp_path / "again.journals") == all_of_them
    assert list(tmp_path.glob("**/*.partial")) == []


def test_a_folder_that_may_not_be_written_is_one_clear_error(tmp_path):
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o555)
    error = one_line(record(closed / "demos", before=BOUND))
    assert "Permission denied" in error
    assert str(closed) in error
    assert list(closed.iterdir()) == []


def test_a_second_recorder_is_refused_by_the_firsts_process_id(tmp_path):
    root = tmp_path / "demos"
    words = [sys.executable, "-m", "manip_il.cli.main", *WORDS, f"--dataset.root={root}", "--dataset.num_episodes=1000"]
    first = subprocess.Popen(words, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 600
        while not list_episodes(tmp_path / "demos.journals"):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        for more in ("--resume=true", "--overwrite=true"):
            assert f"in use by process {first.pid}" in one_line(record(root, more))
    finally:
        first.kill()
        first.wait()
    for path in list_episodes(tmp_path / "demos.journals"):
        read_journal(path)


def test_a_camera_that_cannot_render_is_one_clear_error_before_anything_is_recorded(tmp_path):
    environment = os.environ | {"MUJOCO_GL": "glfw", "DISPLAY": ""}
    error = one_line(record(tmp_path / "demos", "--cameras=front", env=environment))
    assert "OpenGL" in error
    assert "MUJOCO_GL" in error
    assert not (tmp_path / "demos").exists()
    assert list_episodes(tmp_path / "demos.journals") == []
