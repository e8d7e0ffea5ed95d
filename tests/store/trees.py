"""Small datasets and runs to push, and how to tell whether two folders are the same."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from huggingface_hub.utils import _http as hub_http

from manip_il.cli.push_pull import open_remote
from manip_il.store.errors import Retry
from manip_il.store.object_store import ObjectRemote
from manip_il.store.remote import RemoteUrl


def make_run(folder: Path, seed: int, files: int = 12, size: int = 20_000) -> Path:
    """A run's folder with random content; what two seeds share is `same.json` alone."""
    rng = np.random.default_rng(seed)
    model = folder / "checkpoints" / "000004" / "pretrained_model"
    model.mkdir(parents=True)
    (folder / "checkpoints" / "last").symlink_to("000004")
    (folder / "config.yaml").write_text(f"# manip-il\nseed: {seed}\n")
    (folder / "same.json").write_text("{}")
    (folder / "copy.json").write_text("{}")
    (folder / "empty.txt").write_bytes(b"")
    (model / "model.safetensors").write_bytes(rng.bytes(30 * size))
    for number in range(files):
        path = folder / f"round_{number % 3:03d}" / f"part {number}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(rng.bytes(size))
    return folder


def content(folder: Path) -> dict[str, Any]:
    """Everything below: bytes of files, targets of links."""
    return {
        path.relative_to(folder).as_posix(): os.readlink(path) if path.is_symlink() else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_symlink() or path.is_file()
    }


@contextlib.contextmanager
def silent(total: int, what: str) -> Iterator[Callable[[int], None]]:
    """No progress; but all bytes must have been told of, and no more."""
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count

    yield advance
    assert done == total, f"{what}: told of {done} of {total} bytes"


def unwatched(total: int, what: str) -> contextlib.AbstractContextManager[Callable[[int], None]]:
    """No progress; a pull that starts over tells of some bytes twice."""
    return contextlib.nullcontext(lambda _: None)


def impatient(url: str, waits: list[float] | None = None) -> tuple[RemoteUrl, ObjectRemote]:
    """A remote that does not wait between tries, but says how long it would have."""
    parsed = RemoteUrl.parse(url)
    remote = open_remote(parsed)
    assert isinstance(remote, ObjectRemote)
    remote.retry = no_wait(waits)
    return parsed, remote


def wait_little(patch: pytest.MonkeyPatch, tries: int = 6) -> None:
    """Every `Retry` that the program makes, and huggingface_hub's own tries, follow each other almost at once.

    A dataclass keeps its defaults in its constructor: to set them on the class would change nothing.
    """
    usual = Retry.__init__.__defaults__
    assert usual is not None
    patch.setattr(Retry.__init__, "__defaults__", (tries, 0.01, *usual[2:]))
    patch.setattr(hub_http, "time", SimpleNamespace(sleep=lambda seconds: time.sleep(min(seconds, 0.01))))


def no_wait(waits: list[float] | None = None) -> Retry:
    return Retry(sleep=waits.append if waits is not None else lambda _: None, rng=np.random.default_rng(0))
