"""The files of one commit of a Hub's repository, and the manifest that they are."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from huggingface_hub import RepoFile

from manip_il.checks import shorten, text, whole
from manip_il.store.errors import ManifestError
from manip_il.store.manifest import LARGEST, MOST_FILES, FileEntry, Kind, Manifest
from manip_il.store.paths import is_hidden
from manip_il.store.remote import MANIFEST_FILE

MOST_ENTRIES = 2 * MOST_FILES  # with folders
SMALL = 20_000_000  # a Hub puts larger files into LFS, which knows their sha256 [bytes]


@dataclass(frozen=True)
class Tree:
    """Path -> file of a commit; hidden ones (`.gitattributes`) are the Hub's own."""

    commit: str
    files: Mapping[str, RepoFile]

    @classmethod
    def of(cls, commit: str, files: Iterable[object]) -> Tree:
        """From what `list_repo_tree` gives. Raises `ManipError` for an entry that is none, and for too many."""
        found: dict[str, RepoFile] = {}
        for count, one in enumerate(files, start=1):
            if count > MOST_ENTRIES:
                raise ManifestError(f"the commit {commit} has more than {MOST_ENTRIES:,} files and folders: refused")
            if isinstance(one, RepoFile) and not is_hidden(_checked(one).path):
                found[one.path] = one
        return cls(commit, found)

    @property
    def own(self) -> Mapping[str, RepoFile]:
        """Without our manifest."""
        return {path: file for path, file in self.files.items() if path != MANIFEST_FILE}

    def manifest(self, kind: Kind, stored: Manifest | None) -> Manifest:
        """What readers of the commit see. stored: our manifest there, which knows the sha256 of what is not in LFS.

        It is believed where git's hash says that its file is still the one. Raises `ManifestError` for files that no
        push of ours makes.
        """
        known = stored.by_path if stored else {}
        return Manifest(kind, tuple(_entry(file, known.get(path)) for path, file in self.own.items()))

    def holds(self, entry: FileEntry) -> bool:
        """Return whether the commit has this file with these bytes. entry: with both hashes where it is small."""
        there = self.files.get(entry.path)
        if there is None or there.size != entry.size:
            return False
        return there.lfs.sha256 == entry.sha256 if there.lfs else there.blob_id == entry.git_sha1

    def lists(self, listed: bytes) -> bool:
        """Return whether the commit has our manifest with this content."""
        file = self.files.get(MANIFEST_FILE)
        if file is None:
            return False
        if file.lfs:
            return file.lfs.sha256 == hashlib.sha256(listed).hexdigest()
        return file.blob_id == _git_sha1(io.BytesIO(listed), len(listed))

    def differences(self, manifest: Manifest) -> list[str]:
        """Paths that the commit does not hold as the manifest has them, or holds beyond it."""
        wrong = [entry.path for entry in manifest.files if not self.holds(entry)]
        return wrong + sorted(set(self.own) - set(manifest.by_path))


def with_git(manifest: Manifest, local: Mapping[str, Path]) -> Manifest:
    """Return the manifest with git's hash of every file that may not go into LFS."""
    files = tuple(_with_git(entry, local[entry.path]) if entry.size < SMALL else entry for entry in manifest.files)
    return replace(manifest, files=files, replaced=())


def _with_git(entry: FileEntry, path: Path) -> FileEntry:
    with path.open("rb") as file:
        return replace(entry, git_sha1=_git_sha1(file, entry.size))


def _git_sha1(file: BinaryIO, size: int) -> str:
    """Git's id of a file of `size` bytes (`git hash-object`)."""
    digest = hashlib.sha1(b"blob %d\0" % size, usedforsecurity=False)
    while chunk := file.read(2**20):
        digest.update(chunk)
    return digest.hexdigest()


def _checked(file: RepoFile) -> RepoFile:
    """As a Hub listed it, with the types that it should have; what they may be is the manifest's affair."""
    text("the path of a file on the Hub", file.path)
    whole(f"the size of {shorten(file.path)} on the Hub", file.size, 0, LARGEST)
    text(f"the hash of {shorten(file.path)} on the Hub", file.blob_id)
    if file.lfs is not None:
        whole(f"the size of {shorten(file.path)} on the Hub", file.lfs.size, 0, LARGEST)
        text(f"the hash of {shorten(file.path)} on the Hub", file.lfs.sha256)
    return file


def _entry(file: RepoFile, known: FileEntry | None) -> FileEntry:
    if file.lfs:
        return FileEntry(file.path, file.lfs.size, file.lfs.sha256)
    if known and known.git_sha1 == file.blob_id and known.size == file.size:
        return FileEntry(file.path, file.size, known.sha256)
    return FileEntry(file.path, file.size, "", file.blob_id)
