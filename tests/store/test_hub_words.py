"""What a user is told when a Hub refuses, in one line that says what to do; and that nobody is told the token."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import pytest

from manip_il.errors import ManipError, UsageError
from manip_il.store.errors import AuthError, NoSpaceError, NotFoundError, RemoteError

from .hub_server import LFS_SECRET, Hub
from .hub_use import DATASET, POLICY, SAMPLE, TOKEN, copy_sample, do_pull, do_push, make_policy
from .hub_wire import Fault


def said(kind: type[ManipError], work: Callable[[], object]) -> str:
    """The one line of the error."""
    with pytest.raises(kind) as caught:
        work()
    text = str(caught.value)
    assert "\n" not in text
    assert TOKEN not in text
    return text


def test_no_token(hub: Hub, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("HF_TOKEN")
    assert "not logged in; run `hf auth login`" in said(AuthError, lambda: do_push(SAMPLE))


def test_a_token_that_nobody_was_given(hub: Hub, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HF_TOKEN", "hf_AnOldToken")
    text = said(AuthError, lambda: do_push(SAMPLE))
    assert "the token is refused" in text
    assert "hf_AnOldToken" not in text


def test_a_token_without_the_right_to_write(hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    do_push(SAMPLE)
    monkeypatch.setenv("HF_TOKEN", hub.add_token("hf_ReadOnlyToken", "user", write=False))
    assert "with write permission" in said(AuthError, lambda: do_push(SAMPLE, "hf://datasets/user/more"))
    copy = copy_sample(tmp_path / "demos")
    (copy / "notes.txt").write_text("new")
    assert "with write permission" in said(AuthError, lambda: do_push(copy))


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


def test_a_name_that_is_taken_by_the_other_type(hub: Hub, tmp_path: Path):
    do_push(SAMPLE)
    policy = make_policy(tmp_path / "act")
    text = said(UsageError, lambda: do_push(policy, "hf://user/demos"))
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


def test_a_server_that_fails_for_good(hub: Hub, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    hub.faults.append(Fault("^PUT ", 100, status=500))
    text = said(RemoteError, lambda: do_push(SAMPLE))
    assert "answered 500" in text
    assert "try again later" in text
    assert LFS_SECRET not in text


def test_the_token_is_nowhere(
    hub: Hub, tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
):
    caplog.set_level(logging.DEBUG)
    hub.faults.append(Fault("^PUT ", status=500))
    do_push(SAMPLE)
    do_push(make_policy(tmp_path / "act"), POLICY)
    do_pull(tmp_path / "back")
    out = capfd.readouterr()
    for text in (caplog.text, out.out, out.err):
        assert TOKEN not in text
        assert LFS_SECRET not in text
    for repo in hub.repos.values():
        for commit, _ in repo.log("main"):
            assert not any(TOKEN.encode() in repo.read(blob) for blob in repo.tree(commit).values())
