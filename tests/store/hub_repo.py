"""One repository of the tests' Hub: a bare git repository, made by git's plumbing, and a folder of LFS objects."""

from __future__ import annotations

import os
import subprocess
import tempfile
import threading
from dataclasses import dataclass, field
from pathlib import Path

MAIN = "refs/heads/main"
LFS_SUFFIXES = (".parquet", ".safetensors", ".mp4", ".mcap", ".png")  # what git attributes send to LFS on the Hub
_POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:{oid}\nsize {size}\n"
_NAME = ("-c", "user.name=hub", "-c", "user.email=hub@localhost")


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


@dataclass
class Repo:
    """One repository; `full_name` is `datasets/user/name` or `models/user/name`."""

    full_name: str
    folder: Path
    owner: str
    private: bool = False
    lock: threading.RLock = field(default_factory=threading.RLock)
    _pointers: dict[str, tuple[str, int]] = field(default_factory=dict)
    _trees: dict[str, dict[str, Blob]] = field(default_factory=dict)
    _refs: dict[str, str] = field(default_factory=dict)  # as git has them: nobody else writes there
    _commits: set[str] = field(default_factory=set)
    _contents: dict[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.lfs.mkdir(parents=True)
        self._git("init", "--quiet", "--bare", "--initial-branch=main", str(self.git))
        self.commit("refs/heads/main", None, {".gitattributes": b"*.parquet filter=lfs\n"}, {}, [], "initial commit")

    @property
    def git(self) -> Path:
        return self.folder / "git"

    @property
    def lfs(self) -> Path:
        return self.folder / "lfs"

    def object_path(self, oid: str) -> Path:
        """Where the LFS object of this sha256 lies."""
        return self.lfs / oid

    def refs(self, kind: str) -> dict[str, str]:
        """Name -> commit of all `heads` or `tags`."""
        start = f"refs/{kind}/"
        return {ref.removeprefix(start): sha for ref, sha in sorted(self._refs.items()) if ref.startswith(start)}

    def find(self, revision: str) -> str | None:
        """The commit that a branch, a tag or a commit id names; None for an unknown one."""
        for kind in ("heads", "tags"):
            if revision in (refs := self.refs(kind)):
                return refs[revision]
        return revision if revision in self._commits else None

    def set_ref(self, ref: str, commit: str | None) -> None:
        """Make `ref` point to the commit, or remove it."""
        with self.lock:
            self._git("update-ref", *(("-d", ref) if commit is None else (ref, commit)))
            self._refs = {name: sha for name, sha in self._refs.items() if name != ref}
            self._refs |= {ref: commit} if commit else {}

    def tree(self, commit: str) -> dict[str, Blob]:
        """Path -> file of a commit, LFS pointers followed."""
        if commit not in self._trees:
            files: dict[str, Blob] = {}
            for line in self._git("ls-tree", "-r", "-l", "-z", commit).split("\0")[:-1]:
                about, path = line.split("\t", 1)
                sha, size = about.split()[2:]
                oid, lfs_size = self._pointers.get(sha, (None, int(size)))
                files[path] = Blob(sha, lfs_size, oid)
            self._trees[commit] = files
        return self._trees[commit]

    def read(self, blob: Blob) -> bytes:
        """The bytes of a file."""
        if blob.oid is not None:
            return self.object_path(blob.oid).read_bytes()
        if blob.git_sha1 not in self._contents:
            command = ["git", "--git-dir", str(self.git), "cat-file", "blob", blob.git_sha1]
            self._contents[blob.git_sha1] = subprocess.run(command, check=True, capture_output=True).stdout
        return self._contents[blob.git_sha1]

    def log(self, commit: str) -> list[tuple[str, str]]:
        """(commit, title), newest first."""
        lines = self._git("log", "--format=%H %s", commit).splitlines()
        return [(line[:40], line[41:]) for line in lines]

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
            head = self.refs("heads").get(ref.removeprefix("refs/heads/"))
            if parent is not None and parent != head:
                raise WrongParentError
            texts = {path: _POINTER.format(oid=oid, size=size).encode() for path, (oid, size) in lfs.items()}
            blobs = self._store({**files, **texts})
            self._pointers.update({blobs[path]: lfs[path] for path in texts})
            lines = [f"100644 {sha}\t{path}" for path, sha in blobs.items()]
            lines += [f"0 {'0' * 40}\t{path}" for path in deleted]
            tree = self._tree_of(head, lines)
            parents = ("-p", head) if head else ()
            commit = self._git(*_NAME, "commit-tree", tree, *parents, "-m", title).strip()
            self._commits.add(commit)
            self.set_ref(ref, commit)
            return commit

    def _tree_of(self, head: str | None, lines: list[str]) -> str:
        with tempfile.TemporaryDirectory(dir=self.folder) as scratch:
            index = {"GIT_INDEX_FILE": str(Path(scratch) / "index")}
            if head:
                self._git("read-tree", head, env=index)
            self._git("update-index", "--index-info", input_="".join(f"{line}\n" for line in lines), env=index)
            return self._git("write-tree", env=index).strip()

    def _store(self, files: dict[str, bytes]) -> dict[str, str]:
        """Path -> blob id, by one process for all."""
        with tempfile.TemporaryDirectory(dir=self.folder) as scratch:
            names: list[str] = []
            for number, content in enumerate(files.values()):
                name = Path(scratch) / str(number)
                name.write_bytes(content)
                names.append(str(name))
            text = self._git("hash-object", "-w", "--no-filters", "--stdin-paths", input_="\n".join(names))
        return dict(zip(files, text.split(), strict=True))

    def _git(self, *words: str, input_: str = "", env: dict[str, str] | None = None, check: bool = True) -> str:
        command = ["git", "--git-dir", str(self.git), *words]
        clean = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
        clean |= env or {}
        done = subprocess.run(command, check=False, input=input_, capture_output=True, text=True, env=clean)
        if check and done.returncode:
            raise RuntimeError(f"git {' '.join(words)}: {done.stderr}")
        return done.stdout
