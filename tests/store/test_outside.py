"""What comes from outside: verified, kept inside the folder, never run; and mistakes, in one line without secrets."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from manip_il.cli.main import main
from manip_il.errors import ManipError
from manip_il.store.manifest import Manifest
from manip_il.store.transfer import open_remote, pull, push

from .conftest import DATASET, POLICY, SAMPLE, content, make_run
from .servers import TOKEN, Hub, Sshd

DATA = b"payload"
SHA = hashlib.sha256(DATA).hexdigest()


def manifest_of(path: Any = "x", size: Any = 7, sha256: Any = SHA, **more: Any) -> bytes:
    return json.dumps(
        {"version": 1, "kind": "policy", "files": [{"path": path, "size": size, "sha256": sha256}], **more}
    ).encode()


HOSTILE = (
    *map(manifest_of, ("../x", "/tmp/x", "a/../../x", "", None, ".git/hooks/x", "x.PT", "a/run.py")),
    *(manifest_of(size=-1), manifest_of(sha256=f"../{SHA}"), manifest_of(version=2), b"[]"),
)


@pytest.mark.parametrize("text", HOSTILE)
def test_a_hostile_manifest_is_refused_and_nothing_is_written(text: bytes, tmp_path: Path):
    (tmp_path / "store/objects" / SHA[:2]).mkdir(parents=True)
    (tmp_path / "store/objects" / SHA[:2] / SHA).write_bytes(DATA)
    (tmp_path / "store/manip_il_manifest.json").write_bytes(text)
    before = content(tmp_path)
    with pytest.raises(ManipError):
        pull(open_remote(f"file://{tmp_path}/store", quiet=True), tmp_path / "inner" / "target")
    assert content(tmp_path) == before


def test_bytes_that_differ_are_refused(tmp_path: Path, monkeypatch):
    remote = open_remote(f"file://{tmp_path}/store", quiet=True)
    push(make_run(tmp_path / "run"), remote)
    fetch = remote.fetch

    def lie(manifest: Manifest, folder: Path) -> None:
        fetch(manifest, folder)
        (folder / "new.txt").write_bytes(b"x" + (folder / "new.txt").read_bytes()[1:])

    monkeypatch.setattr(remote, "fetch", lie)
    with pytest.raises(ManipError, match=r"'new\.txt' has the wrong hash"):
        pull(remote, tmp_path / "got")
    assert not list(tmp_path.glob("*got*"))


def test_a_hub_that_names_a_path_or_a_commit_outside_the_folder(hub: Hub, tmp_path: Path):
    push(SAMPLE, open_remote(DATASET, quiet=True))
    sha = hub.repos["datasets/user/demos"].heads["main"].encode()
    for old, new in ((b"meta/info.json", b"../info.json"), (sha, b"../../../../outside"), (b'"size"', b'"sise"')):
        hub.change = lambda line, body, old=old, new=new: body.replace(old, new) if "/api/" in line else body
        with pytest.raises(ManipError):
            pull(open_remote(DATASET, quiet=True), tmp_path / "inner" / "target")
        assert not content(tmp_path)


@pytest.mark.slow  # a bare machine has no sshd
@pytest.mark.parametrize(
    ("url", "code", "says"),
    [
        ("datasets/demos", 2, "the remote is not a URL; expected one such as hf://"),
        ("sftp://me:hun/hunter2@host/x", 2, "in a password write / as %2F"),
        ("file:///no/such/store", 1, "holds nothing that can be pulled; check the address"),
        ("sftp://me:hunter2@127.0.0.1:1/x", 1, "cannot read sftp://me@127.0.0.1:1/x: [Errno None] Unable to connect"),
        ("sftp://OTHER/x", 1, "not found in known_hosts; run `ssh HOST` once"),
        ("sftp://CHANGED/x", 1, "Host key for server '127.0.0.1' does not match"),
    ],
)
def test_a_mistake_is_one_line(url, code, says, hub, bucket, sshd: Sshd, tmp_path, monkeypatch, capsys):
    known = (sshd.home / ".ssh" / "known_hosts").read_text()
    (tmp_path / ".ssh").mkdir()
    (tmp_path / ".ssh" / "known_hosts").write_text(known[:-8] + "AAAAAAA\n")
    monkeypatch.setenv("HOME", str(tmp_path))
    url = url.replace("OTHER", f"localhost:{sshd.port}").replace("CHANGED", f"127.0.0.1:{sshd.port}")
    assert main(["pull", url, str(tmp_path / "got")]) == code
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1
    assert "hunter2" not in said


def test_no_token_is_said(hub: Hub, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys):
    push(make_run(tmp_path / "run"), open_remote(POLICY, private=True, quiet=True))
    for token, says in (("hf_HunterTwoHunterTwo", "hf auth login"), ("", "holds nothing that can be pulled")):
        monkeypatch.setenv("HF_TOKEN", token)
        assert main(["pull", POLICY, str(tmp_path / "got"), "--debug"]) == 1
        said = capsys.readouterr().err
        assert says in said
        assert token not in said or not token
        assert TOKEN not in said
