"""A pipe in a dataset's folder: no reader waits for it, and the doctor names it."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from manip_il.data.frame_cache import open_frame_cache

from manip_il.data import lerobot_layout as layout
from manip_il.data.build import dataset_sha256, merge_datasets
from manip_il.data.dataset import Dataset
from manip_il.data.journal import list_episodes, read_header
from manip_il.doctor.examine import examine_folder, has_errors
from manip_il.errors import ManipError

DATA, VIDEO = "data/chunk-000/file-000.parquet", "videos/observation.images.front/chunk-000/file-000.mp4"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture
def root(filmed_once: Path, tmp_path: Path) -> Path:
    shutil.copytree(filmed_once, tmp_path, dirs_exist_ok=True)
    return tmp_path / "lift"


@pytest.fixture(autouse=True)
def no_reader_waits() -> Iterator[None]:
    signal.alarm(60)  # ends the process: nothing shorter gets one out of `open`
    yield
    signal.alarm(0)


def put_pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def read_all(root: Path) -> None:
    Dataset.open(root).columns()
    list(Dataset.open(root).read_episodes())
    open_frame_cache(root, Dataset.open(root).cameras, max_bytes=10**9, folder=root.with_name("cache"))
    dataset_sha256(root)


@pytest.mark.parametrize("name", [layout.INFO, layout.STATS, layout.TASKS, layout.OURS, DATA, EPISODES, VIDEO, "odd"])
def test_a_pipe_in_a_dataset_is_refused_and_named(root: Path, name: str):
    put_pipe(root / name)
    with pytest.raises((ManipError, OSError), match="regular file"):
        read_all(root)
    with pytest.raises(ManipError):
        merge_datasets([root, root], root.with_name("two"), repo_id="a/b")
    found = examine_folder(root)
    assert has_errors(found)
    assert any(name in str(finding) and "regular file" in str(finding) for finding in found)


def test_a_pipe_for_a_journal_or_beside_a_dataset_holds_nobody_up(root: Path):
    journal = list_episodes(root.with_name("lift.journals"))[0]
    put_pipe(journal)
    put_pipe(root.with_name(".lift.x.partial"))
    with pytest.raises(ManipError, match="regular file"):
        read_header(journal)
    assert any("regular file" in str(finding) for finding in examine_folder(root))


def test_a_file_may_be_reached_by_a_link_as_the_hubs_cache_has_them(root: Path):
    (root / DATA).rename(root.with_name("blob"))
    (root / DATA).symlink_to(root.with_name("blob"))
    read_all(root)
