"""One repository of a Hub: what it is asked, each question tried again where that may help."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import BinaryIO, Literal
from urllib.parse import quote

from huggingface_hub import CommitOperationAdd, CommitOperationDelete, GitRefInfo, HfApi, constants, get_session
from huggingface_hub.errors import RepositoryNotFoundError, RevisionNotFoundError
from huggingface_hub.utils import build_hf_headers, hf_raise_for_status

from manip_il import checks
from manip_il.store.errors import HashError, RemoteError, TransientError
from manip_il.store.hub_client import CONNECT, FILE
from manip_il.store.hub_talk import host, talking
from manip_il.store.hub_tree import Tree
from manip_il.store.manifest import LONGEST_TEXT, Manifest
from manip_il.store.remote import MANIFEST_FILE
from manip_il.store.retry import Retry

Type = Literal["dataset", "model"]
COMMIT = re.compile(r"[0-9a-f]{40}")
_LIBRARY = "manip_il"
_UPLOADS = 8  # threads


@dataclass
class HubRepo:
    """`type` and `place` (USER/NAME) say which; `shown` is its name in messages."""

    endpoint: str
    type: Type
    place: str
    shown: str
    retry: Retry
    api: HfApi = field(init=False)

    def __post_init__(self) -> None:
        self.api = HfApi(endpoint=self.endpoint, library_name=_LIBRARY)

    def find(self, revision: str) -> str | Literal["no repo", "no revision"]:
        """Return the commit that a branch, a tag or a commit id names, or what is not there."""

        def once() -> str:
            try:
                found: object = self.api.repo_info(self.place, repo_type=self.type, revision=revision).sha
                return self._commit(found) if found else "no revision"
            except RevisionNotFoundError:
                return "no revision"
            except RepositoryNotFoundError:
                return "no repo"

        return self.ask(once)

    def exists_as(self, kind: Type) -> bool:
        """Return whether there is a repository of this name and of that type."""
        return self.ask(lambda: self.api.repo_exists(self.place, repo_type=kind))

    def refs(self) -> tuple[dict[str, str], dict[str, str]]:
        """Branches and tags, each name -> commit."""

        def once() -> tuple[dict[str, str], dict[str, str]]:
            refs = self.api.list_repo_refs(self.place, repo_type=self.type)
            return self._heads(refs.branches), self._heads(refs.tags)

        return self.ask(once)

    def create(self, private: bool) -> None:
        """Make the repository where it is missing."""
        self.ask(lambda: self.api.create_repo(self.place, repo_type=self.type, private=private, exist_ok=True))

    def create_branch(self, branch: str) -> None:
        """Make a branch where it is missing, from the main one."""
        self.ask(lambda: self.api.create_branch(self.place, branch=branch, repo_type=self.type, exist_ok=True))

    def create_tag(self, tag: str, commit: str) -> None:
        """Make a tag where it is missing."""
        self.ask(lambda: self.api.create_tag(self.place, tag=tag, revision=commit, repo_type=self.type, exist_ok=True))

    def delete_tag(self, tag: str) -> None:
        """Remove a tag."""
        self.ask(lambda: self.api.delete_tag(self.place, tag=tag, repo_type=self.type))

    def tree(self, commit: str) -> Tree:
        """Return all files of a commit."""

        def once() -> Tree:
            listed = self.api.list_repo_tree(self.place, repo_type=self.type, revision=commit, recursive=True)
            return Tree.of(commit, listed)

        return self.ask(once, listing=True)

    def stored_manifest(self, tree: Tree) -> Manifest | None:
        """Return our manifest of a commit; None where another program pushed it. Raises `ManifestError`."""
        file = tree.files.get(MANIFEST_FILE)
        if file is None:
            return None

        def once() -> bytes:
            buffer = io.BytesIO()
            if self.stream(tree.commit, MANIFEST_FILE, buffer, 0, min(file.size, LONGEST_TEXT)):
                raise TransientError(f"{self.shown}: {MANIFEST_FILE} ended too early")
            return buffer.getvalue()

        return Manifest.from_json(self.retry(once))

    def stream(self, commit: str, path: str, target: BinaryIO, offset: int, size: int) -> int:
        """Write a file's bytes from `offset` on, tried once; how many of `size` were missing at its end.

        Raises `HashError` for a file that is longer.
        """
        prefix = "datasets/" if self.type == "dataset" else ""
        url = f"{self.endpoint}/{prefix}{self.place}/resolve/{commit}/{quote(path)}"
        headers = {**build_hf_headers(library_name=_LIBRARY), "Accept-Encoding": "identity"}
        if offset:
            headers["Range"] = f"bytes={offset}-"
        limits = (CONNECT, float(constants.HF_HUB_DOWNLOAD_TIMEOUT), CONNECT, CONNECT)
        at = offset
        with (
            self._talking(),
            get_session().stream("GET", url, headers=headers, timeout=limits, extensions={FILE: True}) as response,
        ):
            hf_raise_for_status(response)
            skip = offset if response.status_code == 200 else 0  # a server that knows no ranges
            for piece in response.iter_raw():
                kept, skip = piece[skip:], max(0, skip - len(piece))
                at += len(kept)
                if at > size:
                    raise HashError(f"{self.shown}: {path} is longer than the {size:,} bytes it should have")
                target.write(kept)
        return size - at

    def upload(self, branch: str, additions: Sequence[CommitOperationAdd]) -> None:
        """Bring large files there, for a commit to name them; what is there from an earlier try stays as it is."""
        try:
            with self._talking():
                self.api.preupload_lfs_files(
                    self.place, additions, repo_type=self.type, revision=branch, num_threads=_UPLOADS, free_memory=False
                )
        except TransientError as error:  # the library has tried again by itself
            raise RemoteError(
                f"{error}; tried several times, try again later: what has been transferred is kept"
            ) from None

    def commit(
        self, branch: str, parent: str, operations: Sequence[CommitOperationAdd | CommitOperationDelete], title: str
    ) -> str:
        """Return one commit on top of `parent`, tried once. Raises `ConflictError` where that is no longer the head."""
        with self._talking():
            made = self.api.create_commit(
                self.place,
                operations,
                commit_message=title,
                repo_type=self.type,
                revision=branch,
                parent_commit=parent,
            )
            return self._commit(made.oid)

    def ask[T](self, what: Callable[[], T], *, listing: bool = False) -> T:
        """What it answers, in the end. listing: the answer comes in pages."""

        def once() -> T:
            with self._talking(listing=listing):
                return what()

        return self.retry(once)

    @contextlib.contextmanager
    def _talking(self, *, listing: bool = False) -> Iterator[None]:
        with talking(self.shown, self.endpoint, listing=listing):
            yield

    def _heads(self, refs: Sequence[GitRefInfo]) -> dict[str, str]:
        return {checks.text("the name of a branch or tag", one.name): self._commit(one.target_commit) for one in refs}

    def _commit(self, value: object) -> str:
        """A commit's id, which becomes part of URLs, as a Hub answered it."""
        if not isinstance(value, str) or not COMMIT.fullmatch(value):
            text = f"{self.shown}: {host(self.endpoint)} names the commit {checks.shorten(value)}"
            raise RemoteError(f"{text}, expected 40 hexadecimal digits; is it a Hub?")
        return value
