"""What a disk, a folder, another recorder or a missing OpenGL can do to a command: one clear line, nothing lost."""

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

from manip_il.data.journal import list_episodes

pytestmark = pytest.mark.slow

SCENE = ("--robot.type=fetch", "--task.type=reach")
RECORD = ("record", *SCENE, "--dataset.num_episodes=4", "--dataset.root={}/demos")
DAGGER = (
    *("dagger", *SCENE, "--rounds=1", "--demonstrations=2", "--episodes_per_round=2", "--validation_episodes=1"),
    *("--workers=1", "--steps=4", "--policy.width=64", "--output_dir={}/out"),
)
EVAL = ("eval", "--policy.type=expert", *SCENE, "--eval.n_episodes=6", "--eval.films=0", "--output_dir={}/out")
# root writes where it likes, unless it gives that up
BOUND = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.getuid() == 0 else []


def run(folder: Path, words: Sequence[str], *more: str, before: Sequence[str] = (), **popen):
    words = [*before, sys.executable, "-m", "manip_il.cli.main", *(word.format(folder) for word in words), *more]
    return subprocess.run(words, capture_output=True, text=True, timeout=600, check=False, **popen)


def error_of(done: subprocess.CompletedProcess[str]) -> str:
    """The error among what a command printed; there is no more than that one line of it."""
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("manip-il: error:")]
    return line


def episodes(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("episode-*.mcap")}


@pytest.mark.parametrize(
    ("words", "size"),
    [((*RECORD, "--workers=1"), None), ((*RECORD, "--workers=2"), None), (DAGGER, 130_000), (EVAL, 1_000)],
)
def test_a_full_disk_ends_a_command_and_keeps_what_was_finished(tmp_path, words, size):
    calm, full = tmp_path / "calm", tmp_path / "full"
    assert run(calm, words).returncode == 0
    expected = episodes(calm)
    sizes = sorted(map(len, expected.values()))

    def fill() -> None:
        """Let files grow to a limit: the kernel then refuses as it does when a disk is full."""
        limit = size or (sizes[0] + sizes[-1]) // 2
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    error = error_of(run(full, words, preexec_fn=fill))
    assert "File too large" in error
    assert f"cannot write {full}/" in error
    assert "--resume=true" in error
    assert episodes(full).items() <= expected.items()
    assert run(full, words, "--resume=true").returncode == 0
    assert episodes(full) == expected
    # a worker that was killed while it wrote leaves a part, which resuming removes
    assert not [*full.rglob("*.partial"), *full.rglob("*.tmp")]


def test_a_folder_that_may_not_be_written_is_one_clear_error(tmp_path):
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o555)
    error = error_of(run(closed, RECORD, before=BOUND))
    assert "Permission denied" in error
    assert str(closed) in error
    assert list(closed.iterdir()) == []


def test_a_second_recorder_is_refused(tmp_path):
    words = [word.format(tmp_path) for word in (*RECORD, "--dataset.num_episodes=1000", "--workers=1")]
    first = subprocess.Popen([sys.executable, "-m", "manip_il.cli.main", *words], stderr=-3, stdout=-3)
    try:
        deadline = time.monotonic() + 600
        while not list_episodes(tmp_path / "demos.journals"):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        for more in ("--resume=true", "--overwrite=true"):
            assert "in use by another process" in error_of(run(tmp_path, RECORD, more))
    finally:
        first.kill()
        first.wait()


def test_a_camera_that_cannot_render_is_one_clear_error_before_anything_is_recorded(tmp_path):
    environment = os.environ | {"MUJOCO_GL": "glfw", "DISPLAY": ""}
    error = error_of(run(tmp_path, RECORD, "--cameras=front", "--workers=1", env=environment))
    assert "OpenGL" in error
    assert "MUJOCO_GL" in error
    assert not (tmp_path / "demos").exists()
    assert list_episodes(tmp_path / "demos.journals") == []
