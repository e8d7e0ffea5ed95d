"""kill -9 at random moments, in either direction: readers see a whole version, and a second try completes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.store.pull import pull

from .trees import content, impatient, make_run, unwatched

KILLS = int(os.environ.get("MANIP_IL_KILLS", "4"))  # in each direction, on each kind of store


class Killer:
    def __init__(self) -> None:
        script = Path(__file__).with_name("killer.py")
        self.process = subprocess.Popen(
            [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __call__(self, do: str, url: str, folder: Path, after: float | None = None) -> dict[str, Any]:
        command = {"do": do, "url": url, "folder": str(folder), "after": after}
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())


@pytest.fixture
def killer(place: str) -> Iterator[Killer]:
    killer = Killer()  # after the environment says where the store is
    yield killer
    killer.process.stdin.close()
    killer.process.wait(120)


@pytest.mark.slow
def test_pushes(place: str, killer: Killer, tmp_path: Path) -> None:
    runs = [make_run(tmp_path / f"run{n}", n, files=4, size=5_000) for n in range(3)]
    versions = [content(run) for run in runs]
    assert killer("push", place, runs[0])["ended"] == 0
    usual = killer("push", place, runs[1])["seconds"]
    rng, killed, now, read = np.random.default_rng(7), 0, 1, Reader(place)
    for number in range(30 + 5 * KILLS):
        if killed == KILLS:
            break
        new = (now + 1) % 3
        killed += killer("push", place, runs[new], float(rng.uniform(0.05, 1.0) * usual))["ended"] == "killed"
        usual *= 1.0 if killed > number * 0.7 else 0.9  # it was slow when it was measured
        assert read(tmp_path / f"seen{number}") in (versions[now], versions[new])
        assert killer("push", place, runs[new])["ended"] == 0
        assert read(tmp_path / f"then{number}") == versions[new]
        now = new
    assert killed == KILLS


@pytest.mark.slow
def test_pulls(place: str, killer: Killer, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", 1, files=4, size=5_000)
    assert killer("push", place, run)["ended"] == 0
    usual = killer("pull", place, tmp_path / "first")["seconds"]
    rng, killed = np.random.default_rng(8), 0
    for number in range(30 + 5 * KILLS):
        if killed == KILLS:
            break
        target = tmp_path / f"got{number}"
        killed += killer("pull", place, target, float(rng.uniform(0.05, 1.0) * usual))["ended"] == "killed"
        usual *= 1.0 if killed > number * 0.7 else 0.9  # it was slow when it was measured
        if target.exists():
            assert content(target) == content(run)
        else:
            assert killer("pull", place, target)["ended"] == 0
        assert content(target) == content(run)
    assert killed == KILLS


class Reader:
    def __init__(self, place: str):
        self.url, self.remote = impatient(place)

    def __call__(self, target: Path) -> dict[str, bytes | str]:
        pull(self.url, self.remote, target, unwatched)
        seen = content(target)
        shutil.rmtree(target)
        return seen
