"""One repository of a Hub: its API, with retries, and the files of one commit with the manifest that they make."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from urllib.parse import quote

from huggingface_hub import (
    CommitOperationAdd,
    CommitOperationDelete,
    GitRefInfo,
    HfApi,
    RepoFile,
    constants,
    get_session,
)
from huggingface_hub.errors import RepositoryNotFoundError, RevisionNotFoundError
from huggingface_hub.utils import build_hf_headers, hf_raise_for_status

from manip_il import checks
from manip_il.store.disk import git_digest, hash_file
from manip_il.store.errors import HashError, ManifestError, RemoteError, Retry, TransientError
from manip_il.store.hub_http import CONNECT, FILE
from manip_il.store.hub_session import host, hub_session
from manip_il.store.manifest import LARGEST, LONGEST_TEXT, MOST_FILES, FileEntry, Kind, Manifest, is_hidden
from manip_il.store.remote import MANIFEST_FILE, Sink

Type = Literal["dataset", "model"]
COMMIT = re.compile(r"[0-9a-f]{40}")
_LIBRARY = "manip_il"
_UPLOADS = 8  # threads
MOST_ENTRIES = 2 * MOST_FILES  # of one commit, with folders
SMALL = 20_000_000  # larger files are always in LFS, which has their sha256 [bytes]


class HubRepo:
    """Repository `place` (USER/NAME) of a type; `shown` is its name in messages."""

    def __init__(self, endpoint: str, type_: Type, place: str, shown: str, retry: Retry):
        self.shown = shown
        self._endpoint, self._type, self._place, self._retry = endpoint, type_, place, retry
        self._api = HfApi(endpoint=endpoint, library_name=_LIBRARY)

    def find(self, revision: str) -> str | Literal["no repo", "no revision"]:
        """Return the commit of a branch, a tag or a commit id, or what is missing."""

        def once() -> str:
            try:
                found: object = self._api.repo_info(self._place, repo_type=self._type, revision=revision).sha
                return self._commit(found) if found else "no revision"
            except RevisionNotFoundError:
                return "no revision"
            except RepositoryNotFoundError:
                return "no repo"

        return self._query(once)

    def exists_as(self, kind: Type) -> bool:
        """Return whether there is a repository of this name and of type `kind`."""
        return self._query(lambda: self._api.repo_exists(self._place, repo_type=kind))

    def refs(self) -> tuple[dict[str, str], dict[str, str]]:
        """Return branches and tags, each name -> commit."""

        def once() -> tuple[dict[str, str], dict[str, str]]:
            refs = self._api.list_repo_refs(self._place, repo_type=self._type)
            return self._heads(refs.branches), self._heads(refs.tags)

        return self._query(once)

    def create(self, private: bool) -> None:
        """Make the repository if it is missing."""
        self._query(lambda: self._api.create_repo(self._place, repo_type=self._type, private=private, exist_ok=True))

    def create_branch(self, branch: str) -> None:
        """Make a branch of the main one if it is missing."""
        self._query(lambda: self._api.create_branch(self._place, branch=branch, repo_type=self._type, exist_ok=True))

    def create_tag(self, tag: str, commit: str) -> None:
        """Make a tag if it is missing."""
        self._query(
            lambda: self._api.create_tag(self._place, tag=tag, revision=commit, repo_type=self._type, exist_ok=True)
        )

    def delete_tag(self, tag: str) -> None:
        """Remove a tag."""
        self._query(lambda: self._api.delete_tag(self._place, tag=tag, repo_type=self._type))

    def tree(self, commit: str) -> Tree:
        """Return all files of a commit."""

        def once() -> Tree:
            listed = self._api.list_repo_tree(self._place, repo_type=self._type, revision=commit, recursive=True)
            return Tree.of(commit, listed)

        return self._query(once, listing=True)

    def stored_manifest(self, tree: Tree) -> Manifest | None:
        """Return our manifest of a commit; None if another program pushed it. Raises `ManifestError`."""
        file = tree.files.get(MANIFEST_FILE)
        if file is None:
            return None

        def once() -> bytes:
            buffer = io.BytesIO()
            if self.stream(tree.commit, MANIFEST_FILE, buffer, 0, min(file.size, LONGEST_TEXT)):
                raise TransientError(f"{self.shown}: {MANIFEST_FILE} ended too early")
            return buffer.getvalue()

        return Manifest.from_json(self._retry(once))

    def stream(self, commit: str, path: str, target: Sink, offset: int, size: int) -> int:
        """Write a file's bytes from `offset` on, in one try; return how many of `size` were missing at its end.

        Raises `HashError` for a file that is longer.
        """
        prefix = "datasets/" if self._type == "dataset" else ""
        url = f"{self._endpoint}/{prefix}{self._place}/resolve/{commit}/{quote(path)}"
        headers = {**build_hf_headers(library_name=_LIBRARY), "Accept-Encoding": "identity"}
        if offset:
            headers["Range"] = f"bytes={offset}-"
        limits = (CONNECT, float(constants.HF_HUB_DOWNLOAD_TIMEOUT), CONNECT, CONNECT)
        at = offset
        with (
            self._session(),
            get_session().stream("GET", url, headers=headers, timeout=limits, extensions={FILE: True}) as response,
        ):
            hf_raise_for_status(response)
            skip = offset if response.status_code == 200 else 0  # 200: the server ignored the range
            for piece in response.iter_raw():
                kept, skip = piece[skip:], max(0, skip - len(piece))
                at += len(kept)
                if at > size:
                    raise HashError(f"{self.shown}: {path} is longer than the {size:,} bytes it should have")
                target.write(kept)
        return size - at

    def upload(self, branch: str, additions: Sequence[CommitOperationAdd]) -> None:
        """Upload large files, for a commit to name them; those that an earlier try has uploaded are skipped."""
        try:
            with self._session():
                self._api.preupload_lfs_files(
                    self._place,
                    additions,
                    repo_type=self._type,
                    revision=branch,
                    num_threads=_UPLOADS,
                    free_memory=False,
                )
        except TransientError as error:  # the library has tried again by itself
            text = f"{error}; tried several times, try again later: what has been transferred is kept"
            raise RemoteError(text) from None

    def commit(
        self, branch: str, parent: str, operations: Sequence[CommitOperationAdd | CommitOperationDelete], title: str
    ) -> str:
        """Make a commit on top of `parent`, in one try. Raises `ConflictError` if that is not the head."""
        with self._session():
            made = self._api.create_commit(
                self._place,
                operations,
                commit_message=title,
                repo_type=self._type,
                revision=branch,
                parent_commit=parent,
            )
            return self._commit(made.oid)

    def _query[T](self, call: Callable[[], T], *, listing: bool = False) -> T:
        """Return the answer to a call, after tries that may help. listing: it comes in pages."""

        def once() -> T:
            with self._session(listing=listing):
                return call()

        return self._retry(once)

    def _session(self, *, listing: bool = False) -> AbstractContextManager[None]:
        return hub_session(self.shown, self._endpoint, listing=listing)

    def _heads(self, refs: Sequence[GitRefInfo]) -> dict[str, str]:
        return {checks.text("the name of a branch or tag", one.name): self._commit(one.target_commit) for one in refs}

    def _commit(self, value: object) -> str:
        """Check a commit's id, as a Hub answered it: it becomes part of URLs."""
        if not isinstance(value, str) or not COMMIT.fullmatch(value):
            hub = f"{self.shown}: {host(self._endpoint)}"
            raise RemoteError(
                f"{hub} names the commit {checks.shorten(value)}, expected 40 hexadecimal digits; is it a Hub?"
            )
        return value


@dataclass(frozen=True)
class Tree:
    """Files of a commit by path, without hidden ones (`.gitattributes`), which are the Hub's."""

    commit: str
    files: Mapping[str, RepoFile]

    @classmethod
    def of(cls, commit: str, files: Iterable[object]) -> Tree:
        """Check what `list_repo_tree` returns. Raises `ManipError` for a malformed entry, and for too many."""
        found: dict[str, RepoFile] = {}
        for count, one in enumerate(files, start=1):
            if count > MOST_ENTRIES:
                raise ManifestError(f"the commit {commit} has more than {MOST_ENTRIES:,} files and folders: refused")
            if isinstance(one, RepoFile) and not is_hidden(_checked(one).path):
                found[one.path] = one
        return cls(commit, found)

    @property
    def own(self) -> Mapping[str, RepoFile]:
        """Files except our manifest."""
        return {path: file for path, file in self.files.items() if path != MANIFEST_FILE}

    def manifest(self, kind: Kind, stored: Manifest | None) -> Manifest:
        """Return the manifest of the commit. stored: our own of an earlier push, which has the sha256 of small files.

        Its sha256 counts if git's hash shows that the file is unchanged. Raises `ManifestError` for files that no push
        makes.
        """
        known = stored.by_path if stored else {}
        return Manifest(kind, tuple(_entry(file, known.get(path)) for path, file in self.own.items()))

    def holds(self, entry: FileEntry) -> bool:
        """Return whether the commit has this file with these bytes. entry: with both hashes if it is small."""
        there = self.files.get(entry.path)
        if there is None or there.size != entry.size:
            return False
        return there.lfs.sha256 == entry.sha256 if there.lfs else there.blob_id == entry.git_sha1

    def has_manifest(self, listed: bytes) -> bool:
        """Return whether the commit has our manifest with this content."""
        file = self.files.get(MANIFEST_FILE)
        if file is None:
            return False
        if file.lfs:
            return file.lfs.sha256 == hashlib.sha256(listed).hexdigest()
        digest = git_digest(len(listed))
        digest.update(listed)
        return file.blob_id == digest.hexdigest()

    def differences(self, manifest: Manifest) -> list[str]:
        """Return the paths of files that the commit lacks, has with other bytes, or has beyond the manifest."""
        wrong = [entry.path for entry in manifest.files if not self.holds(entry)]
        return wrong + sorted(set(self.own) - set(manifest.by_path))


def with_git_hashes(manifest: Manifest, local: Mapping[str, Path]) -> Manifest:
    """Return the manifest with git's hash of every file that may not go into LFS."""

    def hashed(entry: FileEntry) -> FileEntry:
        if entry.size >= SMALL:
            return entry
        digest = git_digest(entry.size)
        hash_file(local[entry.path], digest)
        return replace(entry, git_sha1=digest.hexdigest())

    return replace(manifest, files=tuple(map(hashed, manifest.files)), replaced=())


def _checked(file: RepoFile) -> RepoFile:
    """Check the types of a file that a Hub listed; `FileEntry` checks the values."""
    checks.text("the path of a file on the Hub", file.path)
    name = checks.shorten(file.path)
    checks.whole(f"the size of {name} on the Hub", file.size, 0, LARGEST)
    checks.text(f"the hash of {name} on the Hub", file.blob_id)
    if file.lfs is not None:
        checks.whole(f"the size of {name} on the Hub", file.lfs.size, 0, LARGEST)
        checks.text(f"the hash of {name} on the Hub", file.lfs.sha256)
    return file


def _entry(file: RepoFile, known: FileEntry | None) -> FileEntry:
    if file.lfs:
        return FileEntry(file.path, file.lfs.size, file.lfs.sha256)
    if known and known.git_sha1 == file.blob_id and known.size == file.size:
        return FileEntry(file.path, file.size, known.sha256)
    return FileEntry(file.path, file.size, "", file.blob_id)
