"""Manifests that somebody made to do harm: refused, and nothing is written outside the target."""

from __future__ import annotations

import hashlib
import json
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from manip_il.store.errors import ManifestError, NotFoundError, RemoteError
from manip_il.store.manifest import FileEntry, Manifest
from manip_il.store.pull import pull
from manip_il.store.push import push

from .trees import content, impatient, make_run, no_wait, unwatched

DATA = b"payload"
SIZE = len(DATA)
SHA = hashlib.sha256(DATA).hexdigest()
NAMES = st.sampled_from(["a", "meta", "x y", "ß", "file.json"])


def file(path: Any, size: Any = SIZE, sha256: Any = SHA, **more: Any) -> dict[str, Any]:
    return {"path": path, "size": size, "sha256": sha256, **more}


def joined(*parts: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return st.tuples(*parts).map("".join)


BAD_PATHS = st.one_of(
    joined(st.sampled_from(["../", "a/../../", "/", "//", "./", "a/./", "a//", "C:/", "C:\\", "..\\", "~/../"]), NAMES),
    joined(
        NAMES, st.sampled_from(["/", "/..", "/../b", "\\b", "\0", "\n", "\x7f", "\u202e", "\u200b", " ", ".", ":s"])
    ),
    joined(
        NAMES,
        st.sampled_from([".pkl", ".pt", ".PTH", ".bin", ".ckpt", ".joblib", ".py", ".so", ".sh", ".\uff50\uff59"]),
    ),
    st.sampled_from(["", ".", "..", ".git/hooks/x", ".ssh/authorized_keys", "a/.bashrc", "NUL", "com1.txt", "a/" * 40]),
    st.text("ab", min_size=1025, max_size=1100),
    st.just("\ud800"),
    st.sampled_from([None, 3, ["a"], {"a": 1}, True]),
)
TWINS = st.sampled_from(
    [
        ("a", "a"),
        ("A", "a"),
        ("ß", "ss"),
        ("é", "e\u0301"),
        ("ﬁ", "fi"),
        ("a", "a/b"),
        ("x/A/1", "x/a/2"),
        ("K", "\u212a"),
    ]
)
BAD_SIZES = st.one_of(
    st.integers(max_value=-1), st.just(10**12 + 1), st.just(2**80), st.sampled_from([1.5, "7", None, True])
)
BAD_HASHES = st.sampled_from(["", SHA[:-1], SHA + "0", SHA.upper(), "../" + SHA, None, 7, "z" * 64])
BAD_TREES = st.one_of(
    BAD_PATHS.map(lambda path: {"version": 1, "kind": "policy", "files": [file("good"), file(path)]}),
    TWINS.map(lambda pair: {"version": 1, "kind": "policy", "files": [file(path) for path in pair]}),
    BAD_SIZES.map(lambda size: {"version": 1, "kind": "policy", "files": [file("good", size)]}),
    BAD_HASHES.map(lambda sha: {"version": 1, "kind": "policy", "files": [file("good", sha256=sha)]}),
    st.sampled_from([0, 2, "1", None, True]).map(lambda n: {"version": n, "kind": "policy", "files": [file("good")]}),
    st.sampled_from(["code", None, 1]).map(lambda kind: {"version": 1, "kind": kind, "files": [file("good")]}),
    st.just({"version": 1, "kind": "policy", "files": [file("link", link="/etc/passwd")]}),
    st.just({"version": 1, "kind": "policy", "files": [file("x")], "run": "x.py"}),
    st.just({"version": 1, "kind": "policy", "files": [file(f"f{n}", 10**11) for n in range(20)]}),
    st.just({"version": 1, "kind": "policy", "files": [file("x")], "replaced": ["../../x"]}),
    st.sampled_from([[], None, 7, "x", {"files": []}, {"version": 1, "kind": "policy", "files": {"a": 1}}]),
)


def store_with(folder: Path, manifest: bytes) -> str:
    """A store whose object is there: only the manifest stands between it and the disk."""
    path = folder / "store" / "objects" / SHA[:2] / SHA
    path.parent.mkdir(parents=True)
    path.write_bytes(DATA)
    (folder / "store" / "manip_il_manifest.json").write_bytes(manifest)
    return f"file://{folder}/store"


@settings(max_examples=150)
@given(BAD_TREES)
@example({"version": 1, "kind": "policy", "files": [file("../escaped.txt")]})
def test_hostile_manifests_are_refused_and_nothing_is_written(tree: Any) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        url, remote = impatient(store_with(folder, json.dumps(tree).encode()))
        (folder / "inner").mkdir()
        before = content(folder)
        with pytest.raises(ManifestError):
            pull(url, remote, folder / "inner" / "target", unwatched)
        assert content(folder) == before
        assert not list((folder / "inner").iterdir())


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"\x80\x04K\x01.",
        b'{"version": NaN}',
        b"[" * 100_000,
        b'{"kind":"a","kind":"b"}',
        b"9" * 5000,
        b"\xff",
    ],
)
def test_what_is_no_manifest_is_refused(text: bytes, tmp_path: Path) -> None:
    url, remote = impatient(store_with(tmp_path, text))
    with pytest.raises(ManifestError, match=r"file://.*/store: the manifest"):
        pull(url, remote, tmp_path / "target", unwatched)
    assert not (tmp_path / "target").exists()


def test_an_honest_manifest_is_taken(tmp_path: Path) -> None:
    manifest = Manifest("policy", (FileEntry("a/b c.json", len(DATA), SHA), FileEntry("ü", len(DATA), SHA)))
    assert Manifest.from_json(manifest.to_json()) == manifest
    url, remote = impatient(store_with(tmp_path, manifest.to_json()))
    pull(url, remote, tmp_path / "target", unwatched)
    assert content(tmp_path / "target") == {"a/b c.json": DATA, "ü": DATA}


@pytest.mark.parametrize(("size", "data"), [(len(DATA), b"pAyload"), (3, DATA), (10**6, DATA)])
def test_bytes_that_are_not_the_manifests_never_get_a_name(size: int, data: bytes, tmp_path: Path) -> None:
    manifest = Manifest("policy", (FileEntry("a", size, SHA),))
    url, remote = impatient(store_with(tmp_path, manifest.to_json()))
    (tmp_path / "store" / "objects" / SHA[:2] / SHA).write_bytes(data)
    with pytest.raises(RemoteError, match=r"hash differs, twice|is longer than the 3 bytes|ended after 7 of 1,000,000"):
        pull(url, remote, tmp_path / "target", unwatched, retry=no_wait())
    assert not (tmp_path / "target").exists()


def test_an_object_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    manifest = Manifest("policy", (FileEntry("a", len(DATA), SHA),))
    url, remote = impatient(store_with(tmp_path, manifest.to_json()))
    (tmp_path / "elsewhere").write_bytes(DATA)
    path = tmp_path / "store" / "objects" / SHA[:2] / SHA
    path.unlink()
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RemoteError, match="cannot read file://"):
        pull(url, remote, tmp_path / "target", unwatched)
    assert not (tmp_path / "target").exists()


def test_a_push_puts_the_file_itself_in_place_of_an_object_that_is_a_link(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", 1)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_bytes(b"theirs")
    (run / "note.txt").write_bytes(b"x" * len(str(elsewhere)))  # as long as the link: a file's size alone does not tell
    url, remote = impatient(f"file://{tmp_path}/store")
    push(run, url, remote, unwatched)
    (path,) = (tmp_path / "store").glob(f"objects/*/{hashlib.sha256((run / 'note.txt').read_bytes()).hexdigest()}")
    path.unlink()
    path.symlink_to(elsewhere)
    _, published = push(run, url, remote, unwatched)
    assert (published.uploaded, path.is_symlink(), elsewhere.read_bytes()) == (1, False, b"theirs")
    pull(url, remote, tmp_path / "target", unwatched)
    assert content(tmp_path / "target") == content(run)


def test_links_planted_in_the_staging_folder_are_not_written_through(tmp_path: Path) -> None:
    manifest = Manifest("policy", (FileEntry("sub/a", len(DATA), SHA), FileEntry("b", len(DATA), SHA)))
    url, remote = impatient(store_with(tmp_path, manifest.to_json()))
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "kept").write_bytes(b"kept")
    staging = tmp_path / ".target.pulling"
    (staging / "tree").mkdir(parents=True)
    (staging / "parts").mkdir()
    (staging / "tree" / "sub").symlink_to(outside)
    (staging / "tree" / "b").symlink_to(outside / "kept")
    (staging / "parts" / SHA).symlink_to(outside / "kept")
    pull(url, remote, tmp_path / "target", unwatched)
    assert content(outside) == {"kept": b"kept"}
    assert content(tmp_path / "target") == {"sub/a": DATA, "b": DATA}


def test_a_manifest_that_names_what_is_gone(tmp_path: Path) -> None:
    url, remote = impatient(store_with(tmp_path, Manifest("policy", (FileEntry("a", 1, "0" * 64),)).to_json()))
    with pytest.raises(NotFoundError, match="has no object"):
        pull(url, remote, tmp_path / "target", unwatched)
