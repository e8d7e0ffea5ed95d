"""A repository on the Hugging Face Hub, or the server at HF_ENDPOINT, through huggingface_hub.

Files keep their paths, so that LeRobot reads them. A push is one commit on top of the version that the folder was
compared with; then the tag `v3.0`, by which LeRobot finds datasets, is moved to that commit. The Hub provides the size
and hash of each file of a commit.
"""

from __future__ import annotations

import glob
import re
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, RepoFile
from huggingface_hub.errors import RepositoryNotFoundError, RevisionNotFoundError
from huggingface_hub.utils import disable_progress_bars

from manip_il import checks
from manip_il.data.lerobot_layout import VERSION
from manip_il.errors import UsageError
from manip_il.store.errors import RemoteError, explained
from manip_il.store.manifest import CARD, CONFIG, MANIFEST_FILE, File, Kind, Manifest, PushPlan, policy_folder

_ADDRESS = re.compile(r"(datasets/|models/)?((?!datasets/|models/)\w[\w.-]*/\w[\w.-]*)(?:@(\w[\w./-]*))?")
_HIDDEN = re.compile(r"(.*/)?\.[^./]")  # such as the Hub's own .gitattributes
_COMMIT = re.compile(r"[0-9a-f]{40}")


class Hub:
    """A repository at a branch, tag or commit. quiet: show no progress bars."""

    def __init__(self, address: str, revision: str | None = None, *, private: bool = False, quiet: bool = False):
        """address: the part after `hf://`. Raises `UsageError` if it is invalid."""
        found = _ADDRESS.fullmatch(address)
        if not found or ".." in address or (revision and found[3] not in (None, revision)):
            text = "expected hf://datasets/USER/NAME[@REVISION] or hf://USER/NAME[@REVISION], and one revision"
            raise UsageError(f"the hf:// address is invalid; {text}")
        self.kind: Kind = "dataset" if found[1] == "datasets/" else "policy"
        self._place, self._revision, self._private = found[2], revision or found[3], private
        self._repo: Any = {"repo_id": self._place, "repo_type": "dataset" if self.kind == "dataset" else "model"}
        self.name = f"hf://{found[1] or ''}{self._place}{f'@{self._revision}' if self._revision else ''}"
        self._api = HfApi(library_name="manip_il")
        if quiet:
            disable_progress_bars()

    def read(self) -> Manifest | None:
        """Return the current version; None if the repository or the revision does not exist."""
        with explained(f"read {self.name}"):
            try:
                head = self._api.repo_info(**self._repo, revision=self._revision).sha or ""
            except (RepositoryNotFoundError, RevisionNotFoundError):
                return None
            if not _COMMIT.fullmatch(head):  # becomes part of paths
                found = f"the commit {checks.shorten(head)}, not 40 hexadecimal digits"
                raise RemoteError(f"{self.name} has {found}; is HF_ENDPOINT a Hub?")
            tree = self._api.list_repo_tree(**self._repo, revision=head, recursive=True)
            files = {
                one.path: File(one.lfs.size, one.lfs.sha256) if one.lfs else File(one.size, git_sha1=one.blob_id)
                for one in tree
                if isinstance(one, RepoFile) and not _HIDDEN.match(one.path) and one.path != MANIFEST_FILE
            }
            copies = root_copies(files) if self.kind == "policy" else {}
            are_equal = all(files.get(name) == files[path] for name, path in copies.items())
            return Manifest(self.kind, files, head, copies=frozenset(copies if are_equal else ()))

    def additions(self, source: Path, local: Mapping[str, Path], folder: Path) -> dict[str, Path]:
        """Write the card and its picture into `folder`; return both, and a run's policy files, by repository path."""
        from manip_il.store.cards import write_cards  # imported here because no other remote needs matplotlib

        added = write_cards(source, self.kind, self._place, folder)
        copies = root_copies(local) if self.kind == "policy" else {}
        return added if copies.keys() & local.keys() else added | {name: local[path] for name, path in copies.items()}

    def write(self, plan: PushPlan) -> None:
        """Commit on top of `plan.before` (the Hub refuses if it is outdated), then move a dataset's tag."""
        with explained(f"push to {self.name}"):
            before = plan.before or self._create()
            gone = before.files.keys() - plan.manifest.files.keys()
            operations = [
                *(CommitOperationAdd(path, str(plan.local[path])) for path in plan.upload),
                *(CommitOperationDelete(path, is_folder=False) for path in sorted(gone)),
            ]
            on: Any = {"revision": self._revision, "parent_commit": before.version}
            if operations:
                self._api.create_commit(**self._repo, operations=operations, commit_message="manip-il push", **on)
            if self.kind == "dataset" and self._revision in (None, "main"):
                self._move_tag()

    def fetch(self, manifest: Manifest, folder: Path) -> None:
        """Download a commit's files into `folder`, without checking hashes."""
        left_out = [".*", "*/.*", *(glob.escape(path) for path in (*manifest.copies, MANIFEST_FILE))]
        with explained(f"pull from {self.name}"):
            self._api.snapshot_download(
                **self._repo, revision=manifest.version, local_dir=folder, ignore_patterns=left_out, force_download=True
            )
        shutil.rmtree(folder / ".cache")  # the library's records of the download

    def _create(self) -> Manifest:
        """Create the repository and the branch; return the branch's content: empty, or as on the main branch."""
        self._api.create_repo(**self._repo, private=self._private, exist_ok=True)
        if self._revision:
            self._api.create_branch(**self._repo, branch=self._revision, exist_ok=True)
        made = self.read()
        if made is None or (made.files and not self._revision):
            raise RemoteError(f"{self.name} was created by another push in the meantime; push again")
        return made

    def _move_tag(self) -> None:
        """Delete LeRobot's tag and create it again on the main branch, because the Hub cannot move tags."""
        refs = self._api.list_repo_refs(**self._repo)
        head = next(one.target_commit for one in refs.branches if one.name == "main")
        tag = next((one.target_commit for one in refs.tags if one.name == VERSION), None)
        if tag not in (None, head):
            self._api.delete_tag(**self._repo, tag=VERSION)
        if tag != head:
            self._api.create_tag(**self._repo, tag=VERSION, revision=head, exist_ok=True)


def root_copies(paths: Collection[str]) -> dict[str, str]:
    """Return which files of a run's policy are copied to the root, name -> path; {} for a policy without a run."""
    folder = policy_folder(path for path in paths if path != CONFIG)
    inside = {path.removeprefix(f"{folder}/"): path for path in paths if folder and path.startswith(f"{folder}/")}
    return {name: path for name, path in inside.items() if "/" not in name and name != CARD}
