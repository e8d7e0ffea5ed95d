"""Files and folders are whole or absent, a folder has one writer, and what a disk refuses names
the path.
"""

import errno
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from manip_il.data.atomic import CHECKPOINT, DATASET, exclusive, new_folder, write_file
from manip_il.errors import FolderExistsError, ManipError, UsageError


def test_a_folder_appears_at_the_end_and_not_after_an_error(tmp_path):
    root = tmp_path / "a" / "new"
    with new_folder(root) as folder:
        (folder / "x").write_text("1")
        assert not root.exists()
    assert (root / "x").read_text() == "1"
    with pytest.raises(ZeroDivisionError), new_folder(tmp_path / "other"):
        _ = 1 / 0
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_what_is_there_is_not_written_over_unless_asked_and_stays_until_the_new_one_is_whole(
    tmp_path,
):
    root = tmp_path / "root"
    (root / "meta").mkdir(parents=True)
    (root / "old").touch()
    for kind, refusal in (("", FolderExistsError), (DATASET, UsageError)):
        with pytest.raises(refusal), new_folder(root, replaces=kind):
            pass
    (root / "meta" / "manip_il.json").write_text('{"fingerprint": {}}')
    with pytest.raises(UsageError), new_folder(root, replaces=CHECKPOINT):
        pass
    with pytest.raises(ZeroDivisionError), new_folder(root, replaces=DATASET):
        _ = 1 / 0
    assert (root / "old").exists()
    with new_folder(root, replaces=DATASET) as folder:
        (folder / "new").touch()
        assert (root / "old").exists()
    assert [path.name for path in root.iterdir()] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["root"]


def test_what_a_killed_writer_left_is_not_in_the_next_folder(tmp_path):
    writer = start("new_folder", tmp_path / "root")
    (tmp_path / ".root.partial" / "half").write_text("killed")
    with (
        pytest.raises(ManipError, match="in use by another process"),
        new_folder(tmp_path / "root"),
    ):
        pass
    kill(writer)
    with new_folder(tmp_path / "root") as folder:
        (folder / "whole").touch()
    assert [path.name for path in tmp_path.iterdir()] == ["root"]
    assert [path.name for path in (tmp_path / "root").iterdir()] == ["whole"]


def test_a_link_in_the_place_of_a_new_folder_is_replaced_and_not_followed(tmp_path):
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "thesis.tex").touch()
    (tmp_path / ".root.partial").symlink_to(victim)
    with new_folder(tmp_path / "root") as folder:
        (folder / "x").touch()
    assert [path.name for path in victim.iterdir()] == ["thesis.tex"]
    assert (tmp_path / "root" / "x").exists()


def test_somebodys_folder_in_the_place_of_a_new_one_is_spared(tmp_path):
    somebodys = tmp_path / ".root.partial"
    somebodys.mkdir()
    (somebodys / "thesis.tex").touch()
    with pytest.raises(UsageError, match=r"\.root\.partial"), new_folder(tmp_path / "root"):
        pass
    assert [path.name for path in somebodys.iterdir()] == ["thesis.tex"]


def test_a_second_writer_is_refused_until_the_first_ends(tmp_path):
    writer = start("exclusive", tmp_path / "root")
    for _ in range(2):
        with (
            pytest.raises(ManipError, match="in use by another process"),
            exclusive(tmp_path / "root"),
        ):
            pass
    kill(writer)
    for _ in range(2):
        with exclusive(tmp_path / "root"), exclusive(tmp_path / "other"):
            pass
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_replaced_whole_and_holds_what_it_held_where_writing_fails(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_file(path, b"one")
    write_file(path, b"old")

    def full_disk(handle: int) -> None:
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(ManipError, match=f"cannot write {path}: No space left"):
        write_file(path, b"new")
    assert path.read_bytes() == b"old"
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


def test_a_full_disk_names_the_path_whichever_library_writes(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000, limits[1]))
    try:
        with (
            pytest.raises(ManipError, match=f"cannot write {tmp_path}/new: File"),
            new_folder(tmp_path / "new") as new,
        ):
            save_file({"weights": np.zeros(1_000)}, new / "model.safetensors")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []


def start(what: str, root: Path) -> subprocess.Popen[str]:
    """A process that holds `root` until it is killed."""
    code = (
        f"import pathlib, sys, time; from manip_il.data.atomic import {what}\n"
        f"with {what}(pathlib.Path(sys.argv[1])): print('in', flush=True); time.sleep(3600)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(root)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "in\n"
    return process


def kill(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait()
