"""What a push to a Hub and a pull from it outlive: cut connections, slow servers, errors, wrong bytes."""

from __future__ import annotations

from pathlib import Path

import pytest

from manip_il.store import hub_http
from manip_il.store.errors import ConflictError, HashError, RemoteError, Retry
from manip_il.store.hub import HubRemote
from manip_il.store.push import scan
from manip_il.store.remote import RemoteUrl, open_remote

from .hub_server import Hub
from .hub_use import DATASET, SAMPLE, do_pull, do_push, files_of_main
from .hub_wire import Fault
from .trees import content, wait_little


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    wait_little(monkeypatch)


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
    seen = files_of_main(hub)
    assert {path: seen[path] for path in content(SAMPLE)} == content(SAMPLE)
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
    assert content(tmp_path / "back") == files_of_main(hub)


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
    scanned = scan(SAMPLE, "dataset")
    with pytest.raises(ConflictError):
        remote.publish(scanned.local, scanned.manifest, before, lambda count: None)
