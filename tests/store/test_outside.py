"""What comes from outside: verified, kept inside the folder, never run.

And mistakes, in one line without secrets.
"""

import gzip
import hashlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import pytest
from huggingface_hub import constants
from hypothesis import given, settings
from hypothesis import strategies as st
from s3fs import S3FileSystem

from manip_il.bridges.store.manifest import Arrival, Manifest
from manip_il.bridges.store.transfer import open_remote, pull, push
from manip_il.cli.main import main
from manip_il.errors import ManipError

from .conftest import DATASET, POLICY, SAMPLE, content, make_run
from .servers import TOKEN, Hub, Sshd, hub_server

DATA = b"payload"
SHA = hashlib.sha256(DATA).hexdigest()


def manifest_of(path: Any = "x.json", size: Any = 7, sha256: Any = SHA, **more: Any) -> bytes:
    return json.dumps(
        {
            "version": 1,
            "kind": "policy",
            "files": [{"path": path, "size": size, "sha256": sha256}],
            **more,
        }
    ).encode()


HOSTILE = (
    *map(
        manifest_of,
        ("../x.md", "/tmp/x.md", "a/../../x.md", "", None, ".git/hooks/x.md", "x.PT", "a/run.py"),
    ),
    *map(
        manifest_of, ("x.so.1", "x.pyw", "x.pyz", "Makefile", "x.py ", "x.json.pkl", "x.md\n", "x")
    ),
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


TEXTS = st.text(max_size=30) | st.sampled_from(
    ["..", "../x.md", "a/../../x.md", "/x.md", ".x.md", "a//b.md", "run.py"]
)
NAMES = TEXTS | st.builds("{}.json".format, TEXTS) | st.builds("{}/{}.md".format, TEXTS, TEXTS)
VALUES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | TEXTS
    | st.lists(TEXTS)
    | st.dictionaries(TEXTS, TEXTS)
)
HASHES = st.sampled_from([SHA, SHA.upper(), f"../{SHA}", SHA[:-1], f"{SHA}/../x"])
FILES = st.fixed_dictionaries(
    {"path": NAMES | VALUES, "size": st.just(len(DATA)) | VALUES, "sha256": HASHES | VALUES},
    optional={"more": VALUES},
)
MANIFESTS = st.fixed_dictionaries(
    {
        "version": st.just(1) | VALUES,
        "kind": st.sampled_from(["policy", "dataset"]) | VALUES,
        "files": st.lists(FILES, max_size=3) | VALUES,
    },
    optional={"replaced": VALUES, "task": TEXTS},
)


@settings(max_examples=200, deadline=None)
@given(MANIFESTS)
def test_whatever_a_manifest_holds_nothing_outside_the_folder_is_read_or_written(
    table: dict[str, Any],
):
    with tempfile.TemporaryDirectory() as name:
        folder, objects = Path(name), Path(name, "store", "objects", SHA[:2])
        objects.mkdir(parents=True)
        (objects / SHA).write_bytes(DATA)
        (folder / "x").write_bytes(b"of others")
        (folder / "store" / "manip_il_manifest.json").write_text(json.dumps(table))
        before = content(folder)
        try:
            pull(open_remote(f"file://{folder}/store", quiet=True), folder / "inner" / "target")
        except ManipError:
            assert content(folder) == before
        else:
            after = content(folder)
            new = {path: data for path, data in after.items() if path not in before}
            assert after.items() >= before.items()
            assert all(
                path.startswith("inner/target/") and data == DATA for path, data in new.items()
            )


@pytest.mark.parametrize("endless", ["manifest", "object"])
@pytest.mark.parametrize("scheme", ["file", "s3", pytest.param("sftp", marks=pytest.mark.slow)])
def test_a_file_that_is_larger_than_the_list_says_is_not_taken(
    scheme, endless, tmp_path, monkeypatch, request
):
    """An endless device where the store can hold one, else many times the size."""
    most = 5_000_000
    monkeypatch.setattr("manip_il.checks.LARGEST_READ", most)
    run, store = make_run(tmp_path / "run"), tmp_path / "store"
    url = f"file://{store}"
    if scheme == "sftp":
        server = request.getfixturevalue("sshd")
        monkeypatch.setenv("HOME", str(server.home))
        url = server.url(store)
    if scheme == "s3":
        url = request.getfixturevalue("bucket")
    push(run, open_remote(url, quiet=True))
    name = "manip_il_manifest.json"
    if endless == "object":
        sha256 = hashlib.sha256((run / "new.txt").read_bytes()).hexdigest()
        name = f"objects/{sha256[:2]}/{sha256}"
    if scheme == "s3":
        S3FileSystem(endpoint_url=os.environ["AWS_ENDPOINT_URL"]).pipe_file(
            f"{url}/{name}", bytes(4 * most)
        )
    else:
        (store / name).unlink()
        (store / name).symlink_to("/dev/zero")
    arrived = []
    monkeypatch.setattr(
        Arrival, "call", lambda self, call=Arrival.call: arrived.append(self.value) or call(self)
    )
    with pytest.raises(ManipError):
        pull(open_remote(url, quiet=True), tmp_path / "got")
    assert scheme == "file" or 0 < max(arrived) < 2 * most
    assert not list(tmp_path.glob("*got*"))


@pytest.mark.parametrize("how", ["larger", "compressed"])
def test_a_hub_that_sends_more_than_it_lists_is_not_listened_to(
    how: str, hub: Hub, tmp_path: Path, monkeypatch
):
    push(make_run(tmp_path / "run"), open_remote(POLICY, quiet=True))
    most = 50_000_000
    body = bytes(most) if how == "larger" else gzip.compress(bytes(most))
    hub.change = lambda line, data: body if line.startswith("GET") and "resolve" in line else data
    hub.headers = lambda line: (
        {"Content-Encoding": "gzip"} if how == "compressed" and "GET" in line else {}
    )
    if how == "compressed":
        change = hub.change
        hub.change = lambda line, data: (
            gzip.compress(data) if "GET" in line and "api" in line else change(line, data)
        )
    arrived = []
    monkeypatch.setattr(
        Arrival, "call", lambda self, call=Arrival.call: arrived.append(self.value) or call(self)
    )
    with pytest.raises(ManipError, match="more than"):
        pull(open_remote(POLICY, quiet=True), tmp_path / "got")
    assert max(arrived) < most
    assert not list(tmp_path.glob("*got*"))


@pytest.mark.parametrize("asked", ["/api/models/user/policy?", "/tree/", "/commit/"])
def test_an_answer_without_an_end_is_not_read_to_it(
    asked: str, hub: Hub, tmp_path: Path, monkeypatch
):
    run, most = make_run(tmp_path / "run"), 5_000_000
    push(run, open_remote(POLICY, quiet=True))
    (run / "new.txt").write_text("new")
    monkeypatch.setattr("manip_il.checks.LARGEST_READ", most)
    hub.change = lambda line, body: (
        gzip.compress(body + b" " * 10 * most) if asked in line else body
    )
    hub.headers = lambda line: {"Content-Encoding": "gzip"} if asked in line else {}
    with pytest.raises(ManipError, match="sends more than"):
        push(run, open_remote(POLICY, quiet=True))


def test_a_pipe_in_the_place_of_a_manifest_does_not_hang(tmp_path: Path):
    (tmp_path / "store").mkdir()
    os.mkfifo(tmp_path / "store" / "manip_il_manifest.json")
    with pytest.raises(ManipError, match="not a regular file"):
        pull(open_remote(f"file://{tmp_path}/store", quiet=True), tmp_path / "got")


def test_a_list_that_lacks_files_of_the_commit_is_refused(hub: Hub, tmp_path: Path):
    push(SAMPLE, open_remote(DATASET, quiet=True))
    hub.change = lambda line, body: (
        without(body, "data/chunk-000/file-000.parquet") if "/tree/" in line else body
    )
    with pytest.raises(ManipError, match=r"lacks 'data/chunk-000/file-000\.parquet'"):
        pull(open_remote(DATASET, quiet=True), tmp_path / "got")
    assert not list(tmp_path.glob("*got*"))


def without(body: bytes, path: str) -> bytes:
    return json.dumps([one for one in json.loads(body) if one["path"] != path]).encode()


def test_the_token_goes_to_the_hub_alone(hub: Hub, tmp_path: Path):
    push(make_run(tmp_path / "run"), open_remote(POLICY, quiet=True))
    with hub_server() as other:
        other.repos |= hub.repos
        link = f'<{other.url}/api/models/user/policy/tree/main?recursive=true>; rel="next"'
        hub.headers = lambda line: {"Link": link} if "/tree/" in line else {}
        pull(open_remote(POLICY, quiet=True), tmp_path / "got")
        assert other.tokens
        assert set(other.tokens) == {None}
        assert TOKEN in hub.tokens


def test_a_token_from_a_file_is_not_said_however_it_looks(
    hub: Hub, monkeypatch, tmp_path: Path, capsys
):
    (tmp_path / "token").write_text("of no known shape")
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "token"))
    assert main(["pull", POLICY, str(tmp_path / "got"), "--debug"]) == 1
    said = capsys.readouterr().err
    assert "Invalid credentials" in said
    assert "of no known shape" not in said


def test_bytes_that_differ_are_refused(tmp_path: Path, monkeypatch):
    remote = open_remote(f"file://{tmp_path}/store", quiet=True)
    push(make_run(tmp_path / "run"), remote)
    download = remote.download

    def lie(manifest: Manifest, folder: Path, path: str) -> None:
        download(manifest, folder, path)
        if path == "new.txt":
            (folder / path).write_bytes(b"x" + (folder / path).read_bytes()[1:])

    monkeypatch.setattr(remote, "download", lie)
    with pytest.raises(ManipError, match=r"'new\.txt' has the wrong hash"):
        pull(remote, tmp_path / "got")
    assert not list(tmp_path.glob("*got*"))


def test_a_hub_that_names_a_path_or_a_commit_outside_the_folder(hub: Hub, tmp_path: Path):
    push(SAMPLE, open_remote(DATASET, quiet=True))
    sha = hub.repos["datasets/user/demos"].heads["main"].encode()
    for old, new in (
        (b"meta/info.json", b"../info.json"),
        (sha, b"../../../../outside"),
        (b'"size"', b'"sise"'),
    ):
        hub.change = lambda line, body, old=old, new=new: (
            body.replace(old, new) if "/api/" in line else body
        )
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
        (
            "sftp://me:hunter2@127.0.0.1:1/x",
            1,
            "cannot read sftp://me@127.0.0.1:1/x: [Errno None] Unable to connect",
        ),
        ("sftp://OTHER/x", 1, "not found in known_hosts; run `ssh HOST` once"),
        ("sftp://CHANGED/x", 1, "Host key for server '127.0.0.1' does not match"),
    ],
)
def test_a_mistake_is_one_line(
    url, code, says, hub, bucket, sshd: Sshd, tmp_path, monkeypatch, capsys
):
    known = (sshd.home / ".ssh" / "known_hosts").read_text()
    (tmp_path / ".ssh").mkdir()
    (tmp_path / ".ssh" / "known_hosts").write_text(known[:-8] + "AAAAAAA\n")
    monkeypatch.setenv("HOME", str(tmp_path))
    url = url.replace("OTHER", f"localhost:{sshd.port}").replace(
        "CHANGED", f"127.0.0.1:{sshd.port}"
    )
    assert main(["pull", url, str(tmp_path / "got")]) == code
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1
    assert "hunter2" not in said


def test_no_token_is_said(hub: Hub, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys):
    push(make_run(tmp_path / "run"), open_remote(POLICY, private=True, quiet=True))
    for token, says in (
        ("hf_HunterTwoHunterTwo", "hf auth login"),
        ("", "holds nothing that can be pulled"),
    ):
        monkeypatch.setenv("HF_TOKEN", token)
        assert main(["pull", POLICY, str(tmp_path / "got"), "--debug"]) == 1
        said = capsys.readouterr().err
        assert says in said
        assert token not in said or not token
        assert TOKEN not in said
