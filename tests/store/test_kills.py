"""kill -9 at random moments, in either direction: readers see a whole version, and a second try completes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.store.pull import pull

from .conftest import url_on
from .hub_server import Hub, clean_environment
from .hub_use import DATASET, TOKEN, copy_sample, files_of_main, other_version
from .trees import content, impatient, make_run, unwatched

KILLS = int(os.environ.get("MANIP_IL_KILLS", "4"))  # in each direction, on each kind of remote
ROOT = Path(__file__).parents[2]


class Killer:
    """The process whose forks push and pull, for one URL and some folders to push there by turns."""

    def __init__(self, url: str, sources: list[Path], environment: dict[str, str], hub: Hub | None = None):
        self.url, self.sources, self.hub = url, sources, hub
        words = [sys.executable, "-m", "tests.store.killer"]
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self._process = subprocess.Popen(words, **pipes, text=True, env=environment, cwd=ROOT)

    def __call__(self, do: str, folder: Path, after: float | None = None) -> dict[str, Any]:
        command = {"do": do, "url": self.url, "folder": str(folder), "after": after}
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def read(self, folder: Path) -> dict[str, bytes]:
        """What readers see now."""
        if self.hub:
            return files_of_main(self.hub)
        url, remote = impatient(self.url)
        pull(url, remote, folder, unwatched)
        seen = content(folder)
        shutil.rmtree(folder)
        return seen

    def push_all(self, folder: Path) -> list[dict[str, bytes]]:
        """What readers see after a whole push of each source."""
        versions = []
        for source in self.sources:
            assert self("push", source)["ended"] == 0
            versions.append(self.read(folder))
            assert self.hub or versions[-1] == content(source)
        return versions

    def kill_often(self, usual: float, seed: int, run: Callable[[int, float], bool]) -> None:
        """Run rounds, each with its number and the time to kill it at, until enough were killed."""
        rng, killed = np.random.default_rng(seed), 0
        for number in range(30 + 5 * KILLS):
            if killed == KILLS:
                return
            killed += run(number, float(rng.uniform(0.05, 1.0) * usual))
            usual *= 1.0 if killed > number * 0.7 else 0.9  # it was slow when it was measured
        assert killed == KILLS

    def close(self) -> None:
        assert TOKEN not in self._process.communicate(timeout=120)[1]


@pytest.fixture(params=["file", "s3", "sftp", "hub"])
def killer(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Killer]:
    if request.param == "hub":
        hub: Hub = request.getfixturevalue("hub")
        sources = [copy_sample(tmp_path / "a" / "demos"), other_version(tmp_path / "b" / "demos")]
        kept = {name: value for name, value in os.environ.items() if not name.startswith("HF_")}
        killer = Killer(DATASET, sources, kept | clean_environment(hub, tmp_path / "home", TOKEN), hub)
    else:
        url = url_on(request.param, request, tmp_path, monkeypatch)
        sources = [make_run(tmp_path / f"run{n}", n, files=4, size=5_000) for n in range(3)]
        killer = Killer(url, sources, dict(os.environ))
    yield killer
    killer.close()


@pytest.mark.slow
def test_pushes(killer: Killer, tmp_path: Path) -> None:
    versions, sources = killer.push_all(tmp_path / "seen"), killer.sources
    now, usual = 0, killer("push", sources[0])["seconds"]

    def one(number: int, after: float) -> bool:
        nonlocal now
        new = (now + 1) % len(sources)
        was_killed = killer("push", sources[new], after)["ended"] == "killed"
        assert killer.read(tmp_path / "seen") in (versions[now], versions[new])
        assert killer("push", sources[new])["ended"] == 0
        assert killer.read(tmp_path / "seen") == versions[new]
        if killer.hub:
            repo = killer.hub.repo("datasets/user/demos")
            assert repo.refs("tags")["v3.0"] == repo.refs("heads")["main"]
        now = new
        return was_killed

    killer.kill_often(usual, 7, one)


@pytest.mark.slow
def test_pulls(killer: Killer, tmp_path: Path) -> None:
    version = killer.push_all(tmp_path / "seen")[-1]
    usual = killer("pull", tmp_path / "first")["seconds"]

    def one(number: int, after: float) -> bool:
        target = tmp_path / f"got{number}"
        was_killed = killer("pull", target, after)["ended"] == "killed"
        if target.exists():
            assert content(target) == version
        else:
            assert killer("pull", target)["ended"] == 0
        assert content(target) == version
        # Killed right after the rename, a pull has left an empty folder.
        assert not [path for path in tmp_path.glob(".got*/**/*") if path.is_file()]
        return was_killed

    killer.kill_often(usual, 8, one)
