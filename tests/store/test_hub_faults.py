"""What a push to a Hub and a pull from it outlive: kills, cut connections, slow servers, errors, wrong bytes."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from manip_il.store import hub_http
from manip_il.store.errors import ConflictError, HashError, RemoteError, Retry
from manip_il.store.hub import HubRemote
from manip_il.store.remote import MANIFEST_FILE, RemoteUrl, open_remote

from .hub_server import Hub, clean_environment
from .hub_use import DATASET, SAMPLE, TOKEN, a_hub, contents, copy_sample, do_pull, do_push, other_version
from .hub_wire import Fault
from .trees import wait_little

KILLS = int(os.environ.get("MANIP_IL_KILLS", "4"))  # of each direction


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    wait_little(monkeypatch)


def _files(hub: Hub) -> dict[str, bytes]:
    """What a reader of the main branch sees."""
    repo = hub.repo("datasets/user/demos")
    tree = repo.tree(repo.refs("heads")["main"])
    hidden = (MANIFEST_FILE, ".gitattributes")
    return {path: repo.read(blob) for path, blob in tree.items() if path not in hidden}


PUSH_FAULTS = {
    "a 500 for an upload": Fault("^PUT ", status=500),
    "an upload cut in the middle": Fault("^PUT ", cut=40_000),
    "429 with Retry-After": Fault("/preupload/", status=429, headers={"Retry-After": "0"}),
    "429 for the commit": Fault("/commit/", 2, status=429, headers={"Retry-After": "0"}),
    "a commit cut in the middle": Fault("/commit/", cut=2000),
    "a commit whose answer is lost": Fault("/commit/", lost=True),
    "a 503 for the tag": Fault("POST .*/tag/", status=503),
    "a tag whose answer is lost": Fault("POST .*/tag/", lost=True),
    "a repository whose answer is lost": Fault("/repos/create", lost=True),
    "a slow server": Fault("^PUT ", pause=0.02),
}


@pytest.mark.parametrize("fault", PUSH_FAULTS.values(), ids=PUSH_FAULTS)
def test_a_push_outlives(hub: Hub, fault: Fault):
    hub.faults.append(fault)
    do_push(SAMPLE)
    assert fault.times < 1 or fault.match == "/commit/"
    seen = _files(hub)
    assert {path: seen[path] for path in contents(SAMPLE)} == contents(SAMPLE)
    repo = hub.repo("datasets/user/demos")
    assert len(repo.log(repo.refs("heads")["main"])) == 2  # the Hub's own first one, and one of this push
    assert repo.refs("tags")["v3.0"] == repo.refs("heads")["main"]


PULL_FAULTS = {
    "a 500": Fault("GET .*/resolve/.*parquet", 3, status=500),
    "429 with Retry-After": Fault("GET .*/resolve/", 2, status=429, headers={"Retry-After": "0"}),
    "downloads cut in the middle": Fault("GET .*/resolve/.*parquet", 3, cut=50_000),
    "wrong bytes once": Fault("GET .*/resolve/.*parquet", corrupt=True),
    "a slow server": Fault("GET .*/resolve/.*parquet", pause=0.02),
    "a tree cut in the middle": Fault("GET .*/tree/", cut=100),
}


@pytest.mark.parametrize("fault", PULL_FAULTS.values(), ids=PULL_FAULTS)
def test_a_pull_outlives(hub: Hub, tmp_path: Path, fault: Fault):
    do_push(SAMPLE)
    hub.faults.append(fault)
    do_pull(tmp_path / "back")
    assert contents(tmp_path / "back") == _files(hub)


def test_a_download_goes_on_where_it_was_cut(hub: Hub, tmp_path: Path):
    do_push(SAMPLE)
    size = (SAMPLE / "data" / "chunk-000" / "file-000.parquet").stat().st_size
    hub.faults.append(Fault("GET .*/resolve/.*data/chunk", cut=200_000))
    do_pull(tmp_path / "back")
    sent = sum(one.sent for one in hub.requests("GET .*/resolve/.*data/chunk"))
    assert size <= sent < size + 100_000  # what was on its way when the connection was lost


def test_bytes_that_stay_wrong_are_never_taken(hub: Hub, tmp_path: Path):
    do_push(SAMPLE)
    hub.faults.append(Fault("GET .*/resolve/.*meta/info.json", 100, corrupt=True))
    with pytest.raises((HashError, RemoteError), match=r"info\.json"):
        do_pull(tmp_path / "back")
    assert not (tmp_path / "back").exists()


def test_a_server_that_keeps_silent_is_given_up(hub: Hub, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(hub_http, "PATIENCE", 0.2)
    hub.faults.append(Fault("GET /api/datasets", 100, pause=1.0))
    remote = HubRemote(RemoteUrl.parse(DATASET), retry=Retry(tries=2, first=0.01))
    with pytest.raises(RemoteError, match="gave no answer in time; tried 2 times"):
        remote.read()


def test_a_commit_that_somebody_else_made_meanwhile_is_a_conflict_even_when_the_answer_is_lost(hub: Hub):
    do_push(SAMPLE)
    repo = hub.repo("datasets/user/demos")
    head = repo.refs("heads")["main"]
    remote = open_remote(RemoteUrl.parse(DATASET))
    before = remote.read()
    repo.commit("refs/heads/main", head, {"notes.txt": b"theirs"}, {}, [], "theirs")
    hub.faults.append(Fault("/commit/", cut=10))
    from manip_il.store.push import scan

    scanned = scan(SAMPLE, "dataset")
    with pytest.raises(ConflictError):
        remote.publish(scanned.local, scanned.manifest, before, lambda count: None)


class Child:
    """The process whose forks push and pull."""

    def __init__(self, hub: Hub, folder: Path):
        kept = {key: value for key, value in os.environ.items() if not key.startswith("HF_")}
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("hub_child.py"))],
            env=kept | clean_environment(hub, folder / "home", TOKEN),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, do: str, folder: Path, kill_after: float | None = None) -> int:
        """Its exit code, -9 where it was killed in time."""
        job = {"do": do, "folder": str(folder), "url": DATASET}
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        pid = int(self._process.stdout.readline())
        killer = threading.Timer(1e6 if kill_after is None else kill_after, _kill, (pid,))
        killer.start()
        code = int(self._process.stdout.readline())
        killer.cancel()
        killer.join()
        return code

    def seconds(self, do: str, folder: Path) -> float:
        """How long it takes."""
        begin = time.perf_counter()
        assert self.run(do, folder) == 0
        return time.perf_counter() - begin

    def close(self) -> str:
        """What it said."""
        return self._process.communicate(timeout=120)[1]


def _kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):  # it has just ended
        os.kill(pid, signal.SIGKILL)


class Kills:
    """Kills one kind of work at random moments of the time that it takes."""

    def __init__(self, child: Child, do: str, usual: float):
        self._child, self._do, self._usual = child, do, usual
        self._rng = np.random.default_rng(7)
        self.count = 0

    def __call__(self, folder: Path) -> None:
        if self.count == KILLS:
            return
        code = self._child.run(self._do, folder, float(self._rng.uniform(0.05, 1.0)) * self._usual)
        assert code in (0, -signal.SIGKILL)
        if code:
            self.count += 1
        else:
            self._usual *= 0.9  # it was slow when it was measured


@pytest.mark.slow
def test_kills_at_random_moments_leave_one_version_and_the_next_try_is_whole(tmp_path: Path):
    sources = [copy_sample(tmp_path / "a" / "demos"), other_version(tmp_path / "b" / "demos")]
    with a_hub(tmp_path / "hub") as hub:
        child = Child(hub, tmp_path)
        versions, took = [], 0.0
        for source in sources:
            took = child.seconds("push", source)
            versions.append(_files(hub))
        push, pull = Kills(child, "push", took), Kills(child, "pull", child.seconds("pull", tmp_path / "first"))
        for number in range(30 + 5 * KILLS):
            if min(push.count, pull.count) == KILLS:
                break
            source, target = sources[number % 2], tmp_path / f"pulled_{number}"
            push(source)
            assert _files(hub) in versions
            assert child.run("push", source) == 0
            assert _files(hub) == versions[number % 2]
            repo = hub.repo("datasets/user/demos")
            assert repo.refs("tags")["v3.0"] == repo.refs("heads")["main"]
            pull(target)
            assert not target.exists() or contents(target) == versions[number % 2]
            if not target.exists():
                assert child.run("pull", target) == 0
            assert contents(target) == versions[number % 2]
            # Killed right after the rename, a pull has left an empty folder.
            assert not [path for path in tmp_path.glob(".pulled_*/**/*") if path.is_file()]
        assert TOKEN not in child.close()
    assert (push.count, pull.count) == (KILLS, KILLS)
