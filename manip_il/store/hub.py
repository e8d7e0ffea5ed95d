"""A dataset or policy as a repository of the Hugging Face Hub, or of a server with its API.

Files keep their paths, so that LeRobot and every other program reads them. A push is one commit on top of the one that
it read; then the tag `v3.0`, by which LeRobot finds datasets, is moved there.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from huggingface_hub import CommitOperationAdd, CommitOperationDelete, constants, get_token

from manip_il.data.lerobot_layout import VERSION
from manip_il.errors import UsageError
from manip_il.store.errors import ConflictError, HashError, NotFoundError, RemoteError, Retry, TransientError
from manip_il.store.hub_http import counted
from manip_il.store.hub_repo import COMMIT, HubRepo, Type, with_git_hashes
from manip_il.store.hub_session import HF, LOGIN, host
from manip_il.store.manifest import FileEntry, Kind, Manifest
from manip_il.store.remote import MANIFEST_FILE, Advance, Published, RemoteUrl, Sink, Snapshot

MAIN = "main"
BATCH_FILES, BATCH_SIZE = 100, 2**28  # uploaded at once: files, bytes
_TYPES: dict[Kind, Type] = {"dataset": "dataset", "policy": "model"}
_TAG_TRIES = 5


@dataclass
class HubRemote:
    """`Remote` of an `hf://` URL, at HF_ENDPOINT, with the token of HF_TOKEN or of `hf auth login`.

    private: of a repository that a push creates.
    """

    url: RemoteUrl
    private: bool = False
    retry: Retry = field(default_factory=Retry)
    warnings: tuple[str, ...] = ()
    threads: int = 8

    def __post_init__(self) -> None:
        self.endpoint = str(constants.ENDPOINT)
        self.kind: Kind = self.url.kind or "policy"
        self.branch = self.url.revision or MAIN
        # A repository of the other kind may have the name.
        self._other = RemoteUrl("hf", self.url.place, "policy" if self.kind == "dataset" else "dataset")
        self._absence = ""
        shown = f"{self.url}" if self.endpoint == HF else f"{self.url} at {host(self.endpoint)}"
        self._repo = HubRepo(self.endpoint, _TYPES[self.kind], self.url.place, shown, self.retry)

    @property
    def name(self) -> str:
        """URL, the endpoint if it is not the public Hub, and the reason if nothing was found."""
        return f"{self._repo.shown}{self._absence}"

    def read(self) -> Snapshot | None:
        """Return what the branch, tag or commit holds; None if there is nothing, and `name` says why."""
        commit = self._repo.find(self.branch)
        self._absence = self._why_not(commit)
        if self._absence:
            return None
        tree = self._repo.tree(commit)
        if not tree.own:
            return None
        return Snapshot(tree.manifest(self.kind, self._repo.stored_manifest(tree)), commit)

    def fetch(self, snapshot: Snapshot, entry: FileEntry, target: Sink, offset: int) -> None:
        """Write the bytes of one file from `offset` on to `target`, in one try, from the snapshot's own commit."""
        if left := self._repo.stream(snapshot.token, entry.path, target, offset, entry.size):
            raise TransientError(f"{self.name}: {entry.path} ended {left:,} bytes too early")

    def intake(self, before: Snapshot | None, size: int) -> None:
        """Take no file without its hash, by which the Hub says whether it has it."""

    def publish(
        self, local: Mapping[str, Path], manifest: Manifest, before: Snapshot | None, progress: Advance
    ) -> Published:
        """Upload, commit on top of `before`, check the commit's files, move the tag.

        Deletes the repository's files that the manifest lacks, except hidden ones. Raises `UsageError` for a revision
        that is not a branch.
        """
        if manifest.kind != self.kind:
            raise UsageError(f"a {manifest.kind} cannot be pushed to {self.url}, which is for a {self.kind}")
        parent = before.token if before else self._begin()
        if before is not None and self.branch != MAIN and self.branch not in self._repo.refs()[0]:
            text = f"{self.name}: {self.branch} is not a branch"
            raise UsageError(f"{text}; push to a branch, or leave it out for main")
        now = self._repo.tree(parent)
        ours = with_git_hashes(manifest, local)
        new = [entry for entry in ours.files if not now.holds(entry)]
        gone = sorted(set(now.own) - set(ours.by_path))
        commit = parent
        if new or gone or not now.has_manifest(ours.to_json()):
            known = before.manifest.keys if before else frozenset[str]()
            adds = self._upload(new, local, known, progress)
            removes = [CommitOperationDelete(path, is_folder=False) for path in gone]
            commit = self._commit([*adds, *removes], ours, parent)
        elif self._repo.find(self.branch) != parent:
            raise ConflictError(self.name)
        if self.kind == "dataset" and self.branch == MAIN:
            self._move_tag(commit)
        size = sum(entry.size for entry in new)
        return Published(len(new), size, len(ours.files) - len(new), len(gone), commit)

    def _why_not(self, found: str) -> str:
        """Say what `HubRepo.find` did not find; nothing if it found the commit."""
        if found == "no repo":
            if self._exists(self._other):
                return f" (there is only a {self._other.kind} of that name, {self._other})"
            hidden = " that this token cannot access" if get_token() else f", for which you {LOGIN}"
            return f" (no such {self.kind}, or a private one{hidden})"
        if found == "no revision":
            branches, tags = self._repo.refs()
            return f" (no revision {self.branch}; there are: {', '.join([*branches, *tags]) or 'none'})"
        return ""

    def _exists(self, url: RemoteUrl) -> bool:
        return self._repo.exists_as(_TYPES[url.kind or self.kind])

    def _begin(self) -> str:
        """Make the repository and the branch if they are missing; return the commit to begin from."""
        if not self._exists(self.url) and self._exists(self._other):
            text = f"{self.url.place} is taken by a {self._other.kind}, {self._other}"
            raise UsageError(f"{text}; choose another name for the {self.kind}")
        if COMMIT.fullmatch(self.branch):
            raise UsageError(f"{self.url}: a commit cannot be pushed to; name a branch, or none for main")
        self._repo.create(self.private)
        is_new = self.branch not in self._repo.refs()[0]
        if is_new and self.branch != MAIN:
            self._repo.create_branch(self.branch)  # a copy of main, which this push replaces
        self._absence = ""
        commit = self._repo.find(self.branch)
        if not COMMIT.fullmatch(commit):
            raise NotFoundError(f"{self.name} is missing, although it was just created; push again")
        if not is_new and self._repo.tree(commit).own:
            raise ConflictError(self.name)  # nothing was there a moment ago
        return commit

    def _upload(
        self, new: Sequence[FileEntry], local: Mapping[str, Path], known: frozenset[str], progress: Advance
    ) -> list[CommitOperationAdd]:
        """Upload new files. Bytes that several files share travel once: the other files are added afterwards."""
        first = {entry.key: entry for entry in reversed(new)}
        twins = [entry for entry in new if first[entry.key] is not entry]
        adds: list[CommitOperationAdd] = []
        for batch in (*_batches(first.values()), *_batches(twins)):
            part = [_addition(entry, local[entry.path]) for entry in batch]
            size = sum(entry.size for entry in batch if entry.sha256 not in known)
            with counted(size, progress):
                self._repo.upload(self.branch, part)
            adds += part
        return adds

    def _commit(
        self, operations: Sequence[CommitOperationAdd | CommitOperationDelete], ours: Manifest, parent: str
    ) -> str:
        """Commit, and check the files of the commit; if the answer is lost, find out whether the commit was made."""
        listed = ours.to_json()
        named = [CommitOperationAdd(MANIFEST_FILE, listed), *operations]
        count = sum(isinstance(one, CommitOperationAdd) for one in operations)
        title = f"manip-il push: {count} files added, {len(operations) - count} removed"

        def once() -> str:
            try:
                return self._repo.commit(self.branch, parent, named, title)
            except (TransientError, ConflictError):
                now = self._repo.find(self.branch)
                if now != parent and (tree := self._repo.tree(now)).has_manifest(listed) and not tree.differences(ours):
                    return now
                raise

        commit = self.retry(once)
        if wrong := self._repo.tree(commit).differences(ours):
            text = f"{self.name} does not hold the bytes that were sent: {', '.join(wrong[:3])}"
            raise HashError(f"{text}; push again, and check the server if it happens again")
        return commit

    def _move_tag(self, commit: str) -> None:
        """Move LeRobot's tag to the branch's head. A Hub cannot move tags: it is missing for a moment."""
        for _ in range(_TAG_TRIES):
            tag = self._repo.refs()[1].get(VERSION)
            if tag is not None and tag != commit:
                with contextlib.suppress(NotFoundError):  # another push was faster
                    self._repo.delete_tag(VERSION)
            if tag != commit:
                self._repo.create_tag(VERSION, commit)
            branches, tags = self._repo.refs()
            commit = branches.get(self.branch, commit)  # after another push meanwhile, the tag goes to its commit
            if tags.get(VERSION) == commit:
                return
        raise RemoteError(f"{self.name} is there, but other pushes keep moving its tag {VERSION}; push again")


def _addition(entry: FileEntry, path: Path) -> CommitOperationAdd:
    operation = CommitOperationAdd(entry.path, str(path))
    operation.upload_info.sha256 = bytes.fromhex(entry.sha256)  # else it would be computed once more
    return operation


def _batches(entries: Iterable[FileEntry]) -> Iterator[list[FileEntry]]:
    batch: list[FileEntry] = []
    for entry in entries:
        batch.append(entry)
        if len(batch) >= BATCH_FILES or sum(one.size for one in batch) >= BATCH_SIZE:
            yield batch
            batch = []
    if batch:
        yield batch
