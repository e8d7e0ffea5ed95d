"""One repository of the tests' Hub: its commits in memory, and a folder of LFS objects."""

from __future__ import annotations

import hashlib
import threading
from dataclasses import dataclass, field
from pathlib import Path

from manip_il.store.disk import git_digest

LFS_SUFFIXES = (".parquet", ".safetensors", ".mp4", ".mcap", ".png")  # what git attributes send to LFS on the Hub


class WrongParentError(Exception):
    """Somebody else committed first."""


@dataclass(frozen=True)
class Blob:
    """A file of one commit. oid, lfs_size: of the LFS object that it points to."""

    git_sha1: str
    size: int
    oid: str | None = None

    @property
    def etag(self) -> str:
        return self.oid or self.git_sha1


@dataclass(frozen=True)
class _Commit:
    parent: str | None
    title: str
    tree: dict[str, Blob]


@dataclass
class Repo:
    """One repository. lfs: folder of its objects, each named by its sha256."""

    lfs: Path
    owner: str
    private: bool = False
    lock: threading.RLock = field(default_factory=threading.RLock)
    _refs: dict[str, str] = field(default_factory=dict)
    _commits: dict[str, _Commit] = field(default_factory=dict)
    _contents: dict[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.lfs.mkdir(parents=True)
        self.commit("refs/heads/main", None, {".gitattributes": b"*.parquet filter=lfs\n"}, {}, [], "initial commit")

    def refs(self, kind: str) -> dict[str, str]:
        """Name -> commit of all `heads` or `tags`."""
        start = f"refs/{kind}/"
        return {ref.removeprefix(start): sha for ref, sha in sorted(self._refs.items()) if ref.startswith(start)}

    def find(self, revision: str) -> str | None:
        """The commit that a branch, a tag or a commit id names; None for an unknown one."""
        known = self._commits.keys()
        return {**dict(zip(known, known, strict=True)), **self.refs("tags"), **self.refs("heads")}.get(revision)

    def set_ref(self, ref: str, commit: str | None) -> None:
        """Make `ref` point to the commit, or remove it."""
        with self.lock:
            others = {name: sha for name, sha in self._refs.items() if name != ref}
            self._refs = others | ({ref: commit} if commit else {})

    def tree(self, commit: str) -> dict[str, Blob]:
        """Path -> file of a commit, LFS pointers followed."""
        return self._commits[commit].tree

    @property
    def files(self) -> dict[str, bytes]:
        """Path -> bytes of what a reader of the main branch sees."""
        return {path: self.read(blob) for path, blob in self.tree(self.refs("heads")["main"]).items()}

    def read(self, blob: Blob) -> bytes:
        """The bytes of a file."""
        return self._contents[blob.git_sha1] if blob.oid is None else (self.lfs / blob.oid).read_bytes()

    def log(self, commit: str | None) -> list[tuple[str, str]]:
        """(commit, title), newest first."""
        found: list[tuple[str, str]] = []
        while commit:
            found.append((commit, self._commits[commit].title))
            commit = self._commits[commit].parent
        return found

    def commit(
        self,
        ref: str,
        parent: str | None,
        files: dict[str, bytes],
        lfs: dict[str, tuple[str, int]],
        deleted: list[str],
        title: str,
    ) -> str:
        """One commit on top of a branch's head. parent: what the head must be; None for whatever it is.

        lfs: path -> (sha256, size). Raises `WrongParentError`.
        """
        with self.lock:
            head = self._refs.get(ref)
            if parent is not None and parent != head:
                raise WrongParentError
            tree = dict(self.tree(head)) if head else {}
            for path, data in files.items():
                tree[path] = Blob(_git_sha1(data), len(data))
                self._contents[tree[path].git_sha1] = data
            for path, (oid, size) in lfs.items():
                pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{oid}\nsize {size}\n"
                tree[path] = Blob(_git_sha1(pointer.encode()), size, oid)
            for path in deleted:
                del tree[path]
            commit = hashlib.sha1(repr((head, title, sorted(tree.items(), key=str))).encode()).hexdigest()
            self._commits[commit] = _Commit(head, title, tree)
            self.set_ref(ref, commit)
            return commit


def _git_sha1(data: bytes) -> str:
    digest = git_digest(len(data))
    digest.update(data)
    return digest.hexdigest()
