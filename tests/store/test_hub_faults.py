"""What a push to a Hub and a pull from it outlive, and what a user is told where they do not: one line, no token."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import pytest

from manip_il.errors import ManipError, UsageError
from manip_il.store import hub_http
from manip_il.store.errors import (
    AuthError,
    HashError,
    NoSpaceError,
    NotFoundError,
    RemoteError,
    Retry,
)
from manip_il.store.hub import HubRemote
from manip_il.store.remote import RemoteUrl

from .hub_server import LFS_SECRET, Hub
from .hub_use import DATASET, POLICY, SAMPLE, TOKEN, copy_sample, do_pull, do_push, files_of_main
from .trees import content, wait_little
from .wire import Fault


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


def said(kind: type[ManipError], work: Callable[[], object]) -> str:
    """The one line of the error."""
    with pytest.raises(kind) as caught:
        work()
    text = str(caught.value)
    assert "\n" not in text
    assert TOKEN not in text
    return text


TOKENS = {
    "none": (None, "not logged in; run `hf auth login`"),
    "unknown": ("hf_AnOldToken", "the token is refused"),
    "read-only": ("hf_ReadOnlyToken", "with write permission"),
}


@pytest.mark.parametrize(("token", "text"), TOKENS.values(), ids=TOKENS)
def test_a_token_that_may_not_push(
    hub: Hub, token: str | None, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    do_push(SAMPLE)
    hub.add_token("hf_ReadOnlyToken", "user", write=False)
    monkeypatch.delenv("HF_TOKEN") if token is None else monkeypatch.setenv("HF_TOKEN", token)
    copy = copy_sample(tmp_path / "demos")
    (copy / "notes.txt").write_text("new")
    for work in (lambda: do_push(SAMPLE, "hf://datasets/user/more"), lambda: do_push(copy)):
        error = said(AuthError, work)
        assert text in error
        assert token is None or token not in error


def test_no_such_repository(hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    text = said(NotFoundError, lambda: do_pull(tmp_path / "back"))
    assert "(no such dataset, or a private one that this token cannot access) holds nothing" in text
    monkeypatch.delenv("HF_TOKEN")
    text = said(NotFoundError, lambda: do_pull(tmp_path / "back"))
    assert "or a private one, for which you run `hf auth login`, or set HF_TOKEN)" in text


def test_no_such_revision(hub: Hub, tmp_path: Path):
    do_push(SAMPLE)
    text = said(NotFoundError, lambda: do_pull(tmp_path / "back", f"{DATASET}@v9.9"))
    assert "no revision v9.9; there are: main, v3.0" in text


def test_a_name_that_is_taken_by_the_other_type(hub: Hub, tmp_path: Path, tiny_policy: Path):
    do_push(SAMPLE)
    text = said(UsageError, lambda: do_push(tiny_policy, "hf://user/demos"))
    assert "user/demos is taken by a dataset, hf://datasets/user/demos; choose another name" in text
    text = said(NotFoundError, lambda: do_pull(tmp_path / "back", "hf://user/demos"))
    assert "there is only a dataset of that name, hf://datasets/user/demos" in text


FULL = {
    "an upload too large": (Fault("^PUT ", 100, status=413), "does not accept files this large; ask who runs it"),
    "a commit too large": (Fault("/commit/", 100, status=413), "does not accept files this large; ask who runs it"),
    "a full disk": (Fault("^PUT ", 100, status=507), "has no space left for this account; delete old files there"),
    "an account that must pay": (Fault("/preupload/", 100, status=402), "has no space left for this account; delete"),
    "a quota": (
        Fault(
            "/repos/create", 100, status=403, headers={"X-Error-Message": "Private repository storage limit reached"}
        ),
        "has no space left for this account (Private repository storage limit reached); delete",
    ),
}


@pytest.mark.parametrize(("fault", "text"), FULL.values(), ids=FULL)
def test_no_space(hub: Hub, fault: Fault, text: str):
    hub.faults.append(fault)
    assert text in said(NoSpaceError, lambda: do_push(SAMPLE))


def test_a_server_that_fails_for_good(hub: Hub):
    hub.faults.append(Fault("^PUT ", 100, status=500))
    text = said(RemoteError, lambda: do_push(SAMPLE))
    assert "answered 500" in text
    assert "try again later" in text
    assert LFS_SECRET not in text


def test_the_token_is_nowhere(
    hub: Hub,
    tmp_path: Path,
    tiny_policy: Path,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
):
    caplog.set_level(logging.DEBUG)
    hub.faults.append(Fault("^PUT ", status=500))
    do_push(SAMPLE)
    do_push(tiny_policy, POLICY)
    do_pull(tmp_path / "back")
    out = capfd.readouterr()
    for text in (caplog.text, out.out, out.err):
        assert TOKEN not in text
        assert LFS_SECRET not in text
    for repo in hub.repos.values():
        for commit, _ in repo.log(repo.find("main")):
            assert not any(TOKEN.encode() in repo.read(blob) for blob in repo.tree(commit).values())
