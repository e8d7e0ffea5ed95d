"""The files of one version of a dataset or run, with sizes and hashes.

`Arrival` counts their bytes as they are downloaded.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, override

from fsspec.callbacks import Callback

from manip_il import checks
from manip_il.bridges.store.errors import RemoteError
from manip_il.data.lerobot_layout import INFO

MANIFEST_FILE = "manip_il_manifest.json"
JOURNALS = "journals"  # name of a folder of journals in a run, which are not pushed
# the link `last` to the newest checkpoint is not pushed; a pull creates it
CHECKPOINTS, LAST = "checkpoints", "last"
# the first once per repository, the second once per policy
CARD, CONFIG = "README.md", "config.json"
_POLICIES = ("pretrained_model", "best/pretrained_model")
_CHECKPOINT = re.compile(rf"{CHECKPOINTS}/\d+/pretrained_model")
_CHUNK = 2**20  # bytes that are copied at a time
_LEFT_OUT = re.compile(r"\..*|.*\.(partial|incomplete|tmp)|__pycache__|" + re.escape(MANIFEST_FILE))
# names of files that hold data; all others could be code, or pickles, which can run code
_DATA = re.compile(
    r".*\.(json|jsonl|ya?ml|toml|txt|md|csv|tsv|log|html|pdf|png|jpe?g|gif|webp|svg|mp4"
    r"|parquet|arrow|mcap|safetensors|npz|npy|onnx|wandb|xml|urdf|stl|obj|mtl|bib)"
    r"|LICENSE|NOTICE|events\.out\.tfevents\.[\w.-]+\.\d+",
    re.I,
)

Kind = Literal["dataset", "policy"]


@dataclass(frozen=True)
class File:
    """Size and hash of a file.

    Attributes:
        size: Size [bytes].
        sha256: The hash of its content; empty if the Hub provides none.
        git_sha1: Its git id, if the Hub provides no sha256.
    """

    size: int
    sha256: str = ""
    git_sha1: str = ""

    def __post_init__(self) -> None:
        """Raise `ManipError` for an invalid size or hash."""
        checks.whole("the size of a remote file", self.size, 0, 2**63)
        if not re.fullmatch("[0-9a-f]{64}|git:[0-9a-f]{40}", self.sha256 or f"git:{self.git_sha1}"):
            raise RemoteError(
                f"a remote file has the hash {checks.shorten(self.sha256)}; expected hexadecimal"
                " digits"
            )

    @classmethod
    def of(cls, path: Path) -> File:
        """Return a file's size and sha256."""
        with checks.open_outside(path, "a file") as file:
            return cls(
                os.fstat(file.fileno()).st_size, hashlib.file_digest(file, "sha256").hexdigest()
            )

    def fits(self, path: Path) -> bool:
        """Return whether a regular file has this size and hash."""
        if path.is_symlink() or not path.is_file() or path.stat().st_size != self.size:
            return False
        digest = (
            hashlib.sha256()
            if self.sha256
            else hashlib.sha1(b"blob %d\0" % self.size, usedforsecurity=False)
        )
        with checks.open_outside(path, "a file") as file:
            hashlib.file_digest(file, lambda: digest)
        return digest.hexdigest() == (self.sha256 or self.git_sha1)


@dataclass(frozen=True)
class Manifest:
    """The files of one version of a dataset or policy.

    Attributes:
        kind: Which of them it is.
        files: Path -> file.
        version: The version's id on the remote.
        copies: Paths at the root that repeat the files of a run's policy; they are not pulled.
    """

    kind: Kind
    files: Mapping[str, File]
    version: str = ""
    copies: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Raise `RemoteError` as `check_path` does."""
        for path in self.files:
            check_path(path)

    def to_json(self) -> bytes:
        """Return the content of the manifest file."""
        files = [
            {"path": path, "size": one.size, "sha256": one.sha256}
            for path, one in sorted(self.files.items())
        ]
        return json.dumps({"version": 1, "kind": self.kind, "files": files}, indent=1).encode()

    @classmethod
    def from_json(cls, data: bytes, version: str) -> Manifest:
        """Read a manifest that `to_json` wrote. Raises `ManipError` for anything else."""
        table = checks.parse_json("the manifest", data)
        try:
            if table["version"] != 1 or table["kind"] not in ("dataset", "policy"):
                raise RemoteError(
                    "the manifest was written by another version of manip-il; use a newer one"
                )
            files = {one["path"]: File(one["size"], one["sha256"]) for one in table["files"]}
            return cls(table["kind"], files, version)
        except (LookupError, TypeError, AttributeError) as error:
            raise RemoteError("the manifest is invalid; push again, to an empty folder") from error


@dataclass(frozen=True)
class PushPlan:
    """The difference between a folder and a remote's version.

    Attributes:
        manifest: The version to be pushed.
        before: The remote's version; None if there is none.
        local: Path in the manifest -> file on this machine.
        upload: Paths of the files to upload.
        remove: Paths of the files to remove.
    """

    manifest: Manifest
    before: Manifest | None
    local: Mapping[str, Path]
    upload: list[str]
    remove: list[str]


class Arrival(Callback):
    """Counts the bytes of one file. Raises `RemoteError` as soon as they are more than `most`.

    fsspec updates it as a callback. huggingface_hub calls it for a new progress bar, and updates
    that.
    """

    def __init__(self, most: int):
        super().__init__()
        self.most = most

    @override
    def call(self, *hook: Any, **given: Any) -> None:
        """Raise `RemoteError` if there are too many bytes."""
        if self.value > self.most:
            raise RemoteError(
                f"it sends more than the {self.most:,} bytes that were expected; nothing was kept"
            )

    def __call__(self, *given: Any, **options: Any) -> Arrival:
        """Return the bar, for huggingface_hub."""
        return self

    def update(self, count: float | None = 1) -> None:
        """Count more bytes."""
        self.relative_update(int(count or 0))

    def copy(self, source: Any, target: str) -> None:
        """Copy an open file to a new one, and count its bytes."""
        with open(target, "wb") as file:
            for chunk in iter(partial(source.read, _CHUNK), b""):
                self.update(len(chunk))
                file.write(chunk)


def check_path(path: object) -> None:
    """Raise `RemoteError` for a path that leads outside its folder, is hidden, or is not of a
    known kind of data.
    """
    parts = (
        path.split("/")
        if isinstance(path, str) and path.isprintable() and "\\" not in path
        else [""]
    )
    if not all(part and not part.startswith(".") for part in parts) or not _DATA.fullmatch(
        parts[-1]
    ):
        expected = (
            "the relative path of a file of data (such as .json, .parquet, .safetensors), no"
            " pickle, no code"
        )
        raise RemoteError(
            f"the file {checks.shorten(path)} is refused; expected {expected}, not hidden"
        )


def list_files(root: Path) -> dict[str, Path]:
    """Return the files of a dataset or run by their paths in the manifest.

    Hidden and unfinished files, and journals, are left out.

    Args:
        root: Folder of the dataset or run.

    Raises:
        RemoteError: for a link, unless it is a run's link to its last checkpoint.
    """
    local: dict[str, Path] = {}
    for path in sorted(root.rglob("*")):
        parts = path.relative_to(root).parts
        if any(map(_LEFT_OUT.fullmatch, parts)) or JOURNALS in parts[:-1]:
            continue
        if path.is_symlink():
            if parts[-2:] != (CHECKPOINTS, LAST):
                raise RemoteError(
                    f"{path} is a link; links are not pushed: replace it with the file itself"
                )
        elif path.is_file():
            local["/".join(parts)] = path
    return local


def datasets_in(folder: Path) -> list[Path]:
    """Return the datasets in a folder: the folder itself, or those of a run's rounds."""
    found = [path.parents[1] for path in folder.rglob(INFO)]
    return sorted(
        root for root in found if not any(map(_LEFT_OUT.fullmatch, root.relative_to(folder).parts))
    )


def policy_folder(paths: Iterable[str]) -> str | None:
    """Return the folder of a run's policy, given the paths of the run's files: "" for the root,
    None if there is none.

    The policy is the best one, if the run has chosen one, else that of the newest checkpoint.
    """
    folders = {path.rpartition("/")[0] for path in paths if path.rpartition("/")[2] == CONFIG}
    steps = sorted(filter(_CHECKPOINT.fullmatch, folders), reverse=True)
    return next((one for one in ("", *_POLICIES, *steps) if one in folders), None)
