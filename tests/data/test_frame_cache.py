"""The frame cache: every row is the dataset's picture of that frame, whole or not at all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from manip_il.data import camera
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.atomic import PARTIAL
from manip_il.data.frame_cache import FRAMES, cache_folder, open_frame_cache
from manip_il.errors import ManipError, MismatchError, UnknownName, UsageError
from manip_il.mdp import Episode

from ..damage import edit_json
from ..pictures import encoded, episode_frames, numbered_episodes, numbers_of, picture, store_pictures, write
from .test_video import largest_file

FRONT, WRIST = KEYS = ["observation.images.front", "observation.images.wrist"]
BYTES = 21 * 3 * 72 * 96  # one camera's, of three episodes
PLENTY = 10 * BYTES


@pytest.fixture
def root(tmp_path: Path, filmed: list[Episode], two: s.RobotTaskSpec) -> Path:
    return write(filmed, tmp_path / "lift", two)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "cache"


def opened(root: Path, folder: Path, *keys: str, max_bytes: int = PLENTY, **options: Any) -> dict[str, Any]:
    frames = open_frame_cache(root, keys or KEYS, max_bytes=max_bytes, folder=folder, **options)
    assert frames is not None
    return frames


def shown(frames: np.ndarray) -> list[int]:
    return numbers_of(frames.transpose(0, 2, 3, 1))


def entries(folder: Path) -> set[str]:
    return {path.parent.name for path in folder.glob(f"[!.]*/{FRAMES}")}


def test_a_row_is_the_frame_of_its_index_bit_by_bit(root, folder):
    frames = opened(root, folder)
    assert list(frames) == KEYS
    assert shown(frames[FRONT]) == list(range(21))
    assert shown(frames[WRIST]) == list(range(21, 42))
    for key, values in frames.items():
        decoded = np.concatenate([episode_frames(root, key, episode) for episode in range(3)])
        np.testing.assert_array_equal(values, decoded.transpose(0, 3, 1, 2))
        assert (values.shape, values.dtype) == ((21, 3, 72, 96), np.uint8)
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0


def test_pieces_files_and_processes_change_nothing(tmp_path, folder, make_episode, two, monkeypatch):
    episodes = numbered_episodes(make_episode, two, 9)
    root = tmp_path / "small"
    write(episodes, root, two, video_files_size_in_mb=0.001)
    assert len(list((root / "videos" / FRONT).rglob("*.mp4"))) > 2
    whole = opened(root, folder, FRONT)
    monkeypatch.setattr(camera, "_PART_BYTES", 1)
    monkeypatch.setattr(camera, "_LEAST", 4)
    told: list[int] = []
    in_pieces = opened(root, tmp_path / "other", FRONT, workers=2, on_frames=told.append)
    assert len(told) > 2
    assert sum(told) == 63
    assert shown(whole[FRONT]) == list(range(63))
    np.testing.assert_array_equal(whole[FRONT], in_pieces[FRONT])


def test_pictures_in_the_data_files_are_the_stored_bytes(tmp_path, folder, make_episode, spec):
    root = write([make_episode(1, 7), make_episode(2, 5)], tmp_path / "lift", spec)
    path = store_pictures(root, FRONT, [encoded(picture(number)) for number in range(12)], (72, 96))
    frames = opened(root, folder, FRONT)[FRONT]
    np.testing.assert_array_equal(frames, np.stack([picture(number).transpose(2, 0, 1) for number in range(12)]))
    rows = pq.read_table(path)
    pq.write_table(rows.take(list(reversed(range(12)))), path, row_group_size=5)
    with pytest.raises(ManipError, match="not in the order of their `index`"):
        opened(root, folder, FRONT)
    pq.write_table(rows.slice(1), path)
    with pytest.raises(ManipError, match="counts 12 frames, its data files 11"):
        opened(root, folder, FRONT)


def test_what_is_there_is_not_decoded_again(root, folder):
    told: list[int] = []
    opened(root, folder, FRONT, on_frames=told.append)
    assert sum(told) == 21
    opened(root, folder, FRONT, on_frames=told.append)
    assert sum(told) == 21
    opened(root, folder, on_frames=told.append)  # the other camera alone is missing
    assert sum(told) == 42
    moved = root.rename(root.with_name("moved"))
    opened(moved, folder, on_frames=told.append)
    assert sum(told) == 42


def test_a_changed_dataset_is_decoded_again(root, folder, make_episode, two):
    video = next((root / "videos" / FRONT).rglob("*.mp4"))
    before = opened(root, folder, FRONT)
    other = numbered_episodes(make_episode, two, 4)[1:]  # one more number in the wrist's; the front's start at 7
    root.rename(root.with_name("old"))
    write(other, root, two)
    assert video.exists()
    assert shown(opened(root, folder, FRONT)[FRONT]) == list(range(7, 28))
    assert shown(before[FRONT]) == list(range(21))
    os.utime(video, ns=(0, 0))  # perhaps other pictures of the same size
    told: list[int] = []
    opened(root, folder, FRONT, on_frames=told.append)
    assert sum(told) == 21


def test_what_does_not_fit_is_left_to_the_plain_path(root, folder):
    assert open_frame_cache(root, KEYS, max_bytes=2 * BYTES - 1, folder=folder) is None
    assert not folder.exists()
    assert opened(root, folder, max_bytes=2 * BYTES)


KILLED = """
import multiprocessing, os, signal, sys
from pathlib import Path
from manip_il.data import camera
from manip_il.data.frame_cache import open_frame_cache

def die(count):
    print(*[child.pid for child in multiprocessing.active_children()], flush=True)
    os.kill(os.getpid(), signal.SIGKILL)

camera._PART_BYTES, camera._LEAST = 1, 4
root, folder, workers = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
open_frame_cache(root, ["observation.images.front"], max_bytes=10**9, folder=folder, workers=workers, on_frames=die)
"""


def kill_while_decoding(root: Path, folder: Path, workers: int) -> list[int]:
    """The process ids of what it had started."""
    words = [sys.executable, "-c", KILLED, str(root), str(folder), str(workers)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == -signal.SIGKILL, done.stderr
    return [int(word) for word in done.stdout.split()]


def test_what_a_kill_leaves_is_neither_used_nor_kept(root, folder):
    kill_while_decoding(root, folder, 1)
    assert entries(folder) == set()
    assert len(list(folder.glob(f".*{PARTIAL}/{FRAMES}"))) == 1
    assert shown(opened(root, folder, FRONT)[FRONT]) == list(range(21))
    assert list(folder.glob(f".*{PARTIAL}")) == []


@pytest.mark.slow  # starting them
def test_processes_that_decode_end_with_the_one_that_started_them(root, folder):
    started = kill_while_decoding(root, folder, 2)
    assert started
    patience = time.monotonic() + 120
    while any(is_running(process) for process in started):
        assert time.monotonic() < patience
        time.sleep(0.05)


def is_running(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_what_is_cut_short_or_another_array_is_decoded_again(root, folder):
    opened(root, folder, FRONT)
    [path] = folder.glob(f"*/{FRAMES}")
    os.truncate(path, BYTES // 2)
    assert shown(opened(root, folder, FRONT)[FRONT]) == list(range(21))
    np.save(path, np.zeros(3))
    assert shown(opened(root, folder, FRONT)[FRONT]) == list(range(21))


def test_a_folder_that_cannot_be_is_one_clear_error(root, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ManipError, match="cannot keep decoded pictures in"):
        opened(root, tmp_path / "file" / "cache")
    with pytest.raises(UsageError, match="is in the dataset"):
        opened(root, root / "cache")
    assert not (root / "cache").exists()


def test_a_full_disk_is_one_clear_error_and_leaves_nothing(root, folder):
    told: list[int] = []
    with largest_file(BYTES // 2), pytest.raises(ManipError, match=r"cannot keep decoded .*File too large; make room"):
        opened(root, folder, FRONT, on_frames=told.append)
    assert told == []
    assert not list(folder.iterdir())


def test_a_damaged_dataset_is_named_and_leaves_nothing(root, folder):
    video = next((root / "videos" / FRONT).rglob("*.mp4"))
    content = video.read_bytes()
    video.write_bytes(content[: len(content) // 2])
    for workers in (1, 2):
        with pytest.raises(ManipError, match=r"file-000\.mp4"):
            opened(root, folder, FRONT, workers=workers)
    assert entries(folder) == set()
    video.unlink()
    with pytest.raises(ManipError, match=r"cannot read .*file-000\.mp4: No such file"):
        opened(root, folder, FRONT)


def test_what_is_no_picture_is_refused(root, folder, tmp_path):
    with pytest.raises(UnknownName, match=r"did you mean 'observation\.images\.front'"):
        opened(root, folder, "observation.images.fron")
    with pytest.raises(UnknownName, match="unknown camera"):
        opened(root, folder, s.STATE)
    with pytest.raises(ManipError, match="not a LeRobot dataset"):
        opened(tmp_path / "nothing", folder)
    for changes, error, message in (
        ({"shape": [72, 90, 3]}, MismatchError, r"shape of observation\.images\.front differs"),
        ({"shape": [72, 96, 1]}, ManipError, "expected RGB pictures"),
    ):
        edit_json(root / layout.INFO, lambda info, changes=changes: info["features"][FRONT].update(changes))
        with pytest.raises(error, match=message):
            opened(root, folder, FRONT)
    edit_json(root / layout.INFO, lambda info: info["features"][FRONT].update(shape=[72, 96, 3]))
    edit_json(root / layout.INFO, lambda info: info.update(total_frames=22))
    with pytest.raises(ManipError, match="counts 22 frames, its data files 21"):
        opened(root, folder, FRONT)


def test_the_folder_is_in_the_users_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "manip_il" / "frames"
    for value in ("", "relative"):  # both are to be ignored, says the standard
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert cache_folder() == tmp_path / ".cache" / "manip_il" / "frames"
