"""The list of files of one version of a dataset or policy, with sizes and hashes, and where among them a policy lies.

It comes from outside: on construction it refuses everything but plain files inside a folder, on any system, and code.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast

from manip_il.store.errors import ManifestError

CONFIG = "config.json"  # of every policy
CARD = "README.md"
JOURNALS = "journals"  # folder of a pushed dataset's journals; in a run every folder of that name holds some
CHECKPOINTS = "checkpoints"
LAST = "last"  # the link in `checkpoints` to the newest one: a pull makes it again
_POLICY_FOLDERS = ("", "pretrained_model", "best/pretrained_model")
_CHECKPOINT = re.compile(rf"{CHECKPOINTS}/(\d+)/pretrained_model")
VERSION = 1
MOST_FILES = 200_000
LARGEST = 10**12  # of all files together [bytes]
LONGEST_TEXT = 2**26  # of a manifest [bytes]
_KINDS = ("dataset", "policy")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_SHA1 = re.compile(r"[0-9a-f]{40}")

LONGEST_PATH = 1024  # [bytes]
LONGEST_NAME = 255  # [bytes]
DEEPEST = 32  # folders
_BAD_CATEGORIES = ("Cc", "Cf", "Cs", "Co", "Zl", "Zp")  # control, invisible and half characters, line ends
_PICKLES = (".pkl", ".pickle", ".pt", ".pth", ".bin", ".ckpt", ".joblib", ".dill", ".msgpack")
_CODE = (
    *(".py", ".pyc", ".pyo", ".pyd", ".pyw", ".pyz", ".so", ".dll", ".dylib", ".exe", ".com", ".msi", ".jar", ".class"),
    *(".sh", ".bash", ".zsh", ".fish", ".bat", ".cmd", ".ps1", ".vbs", ".rb", ".pl", ".whl", ".egg", ".ipynb"),
)
_DEVICES = {"con", "prn", "aux", "nul", *(f"{name}{n}" for name in ("com", "lpt") for n in range(1, 10))}

Kind = Literal["dataset", "policy"]


@dataclass(frozen=True)
class FileEntry:
    """One file. path: relative, with `/`. size [bytes]. git_sha1: git's blob id, if a Hub knows no sha256."""

    path: str
    size: int
    sha256: str = ""
    git_sha1: str = ""

    def __post_init__(self) -> None:
        """Raise `ManifestError` for a path that leaves the folder or names code, a wrong size or a wrong hash."""
        check_path(self.path)
        if type(self.size) is not int or self.size < 0:
            raise ManifestError(f"{self.path!r:.200} has size {self.size!r:.40}; expected a number of bytes")
        _check_hash(self.path, "sha256", self.sha256, _SHA256)
        _check_hash(self.path, "git_sha1", self.git_sha1, _SHA1)
        if not self.sha256 and not self.git_sha1:
            raise ManifestError(f"{self.path!r:.200} has no hash; it could not be verified")

    @property
    def key(self) -> str:
        """Identity of its bytes."""
        return self.sha256 or f"git-{self.git_sha1}"


@dataclass(frozen=True)
class Manifest:
    """All files of one version, sorted by path.

    replaced: hashes that only the version before has; a store removes their objects with the next push.
    """

    kind: Kind
    files: tuple[FileEntry, ...]
    replaced: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise `ManifestError` for anything that no push writes."""
        if self.kind not in _KINDS:
            raise ManifestError(f"the manifest is of a {self.kind!r:.40}; expected dataset or policy")
        if len(self.files) > MOST_FILES:
            raise ManifestError(f"the manifest names {len(self.files):,} files; at most {MOST_FILES:,} are accepted")
        object.__setattr__(self, "files", tuple(sorted(self.files, key=lambda entry: entry.path)))
        check_together([entry.path for entry in self.files])
        if self.size > LARGEST:
            raise ManifestError(f"the manifest names {self.size:,} bytes; at most {LARGEST:,} are accepted")
        for sha256 in self.replaced:
            _check_hash("replaced", "sha256", sha256, _SHA256)

    @cached_property
    def size(self) -> int:
        """Size of all files together [bytes]."""
        return sum(entry.size for entry in self.files)

    @cached_property
    def by_path(self) -> Mapping[str, FileEntry]:
        """Entries by path."""
        return {entry.path: entry for entry in self.files}

    @cached_property
    def keys(self) -> frozenset[str]:
        """Identities of all files' bytes."""
        return frozenset(entry.key for entry in self.files)

    def to_json(self) -> bytes:
        """Return the text that a store keeps."""
        files = [{name: value for name, value in vars(entry).items() if value != ""} for entry in self.files]
        replaced = {"replaced": list(self.replaced)} if self.replaced else {}
        return json.dumps({"version": VERSION, "kind": self.kind, "files": files, **replaced}, indent=1).encode()

    @classmethod
    def from_json(cls, data: bytes) -> Manifest:
        """Read a manifest. Raises `ManifestError` for anything that `to_json` does not write."""
        if len(data) > LONGEST_TEXT:
            raise ManifestError(f"the manifest is {len(data):,} bytes long; at most {LONGEST_TEXT:,} are read")
        try:
            tree = json.loads(data, object_pairs_hook=_unique_keys, parse_constant=_refuse_constant)
        except (ValueError, RecursionError) as error:
            raise ManifestError(f"the manifest is not valid JSON: {str(error)[:200]}") from None
        table = _object(tree, "the manifest", {"version", "kind", "files"}, {"replaced"})
        if table["version"] != VERSION or type(table["version"]) is not int:
            text = f"the manifest has version {table['version']!r:.40}, this program reads {VERSION}"
            raise ManifestError(f"{text}; use a newer manip-il")
        tables = [
            _object(file, "a file of the manifest", {"path", "size"}, {"sha256", "git_sha1"})
            for file in _list(table["files"], "files")
        ]
        replaced = _list(table.get("replaced", []), "replaced")
        return cls(table["kind"], tuple(FileEntry(**one) for one in tables), tuple(replaced))


def _object(value: Any, what: str, needed: set[str], allowed: set[str]) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ManifestError(f"{what} is {type(value).__name__}; expected an object")
    table = cast("dict[str, Any]", value)
    if not needed <= table.keys() <= needed | allowed:
        raise ManifestError(f"{what} has the keys {', '.join(table)[:200]!r}; expected {', '.join(sorted(needed))}")
    return table


def _list(value: Any, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise ManifestError(f"{what} of the manifest is {type(value).__name__}; expected a list")
    if len(value) > MOST_FILES:
        raise ManifestError(f"the manifest names {len(value):,} files; at most {MOST_FILES:,} are accepted")
    return value


def _check_hash(path: str, what: str, value: object, pattern: re.Pattern[str]) -> None:
    if not isinstance(value, str) or (value and not pattern.fullmatch(value)):
        raise ManifestError(f"{path!r:.200} has {what} {value!r:.80}; expected hexadecimal digits")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a key appears twice")
    return table


def _refuse_constant(text: str) -> None:
    raise ValueError(f"{text} is not a number")


def check_path(path: object) -> str:
    """Return `path` if it is allowed. Raises `ManifestError` with the reason."""
    if not isinstance(path, str):
        raise ManifestError(f"a manifest names a file {path!r:.80}; expected a string")
    if reason := _reason(path):
        raise ManifestError(f"the file {path!r:.200} is refused: {reason}")
    return path


def check_together(paths: Iterable[str]) -> None:
    """Raise `ManifestError` if two paths are equal on some system, or one is both file and folder."""
    spelled: dict[str, str] = {}  # folded path of a file or folder -> as it was written
    files: set[str] = set()
    for path in paths:
        folded = fold(path)
        if folded in files:
            raise ManifestError(f"the file {path!r:.200} appears twice, also as {spelled[folded]!r:.200}: refused")
        files.add(folded)
        parts = path.split("/")
        for count in range(1, len(parts) + 1):
            part = "/".join(parts[:count])
            if spelled.setdefault(fold(part), part) != part:
                both = f"{part!r:.200} and {spelled[fold(part)]!r:.200}"
                raise ManifestError(f"{both} differ only in case or in how letters are encoded: refused")
    for path in paths:
        parts = path.split("/")
        for count in range(1, len(parts)):
            if fold(folder := "/".join(parts[:count])) in files:
                raise ManifestError(f"{folder!r:.200} is both a file and a folder: refused")


def fold(path: str) -> str:
    """Return the spelling that paths share which a file system may take for one: of any case, of any Unicode form."""
    return unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", path).casefold())


def is_hidden(path: str) -> bool:
    """Return whether a name in the path begins with a dot: such files are neither pushed nor pulled."""
    return any(part.startswith(".") for part in path.split("/"))


def _reason(path: str) -> str:
    if not path or path.startswith("/") or path.endswith("/"):
        return "it is not a relative path of a file"
    if any(unicodedata.category(letter) in _BAD_CATEGORIES for letter in path):
        return "it has invisible characters"
    if any(letter in path for letter in '\\:*?"<>|'):
        return "it has a character that file names cannot have on every system"
    if len(path.encode()) > LONGEST_PATH or path.count("/") > DEEPEST:
        return f"it is longer than {LONGEST_PATH} bytes or deeper than {DEEPEST} folders"
    for part in path.split("/"):
        if part in ("", ".", ".."):
            return "it leads, or could lead, outside the folder"
        if part.startswith("."):
            return "it is hidden"
        if part.endswith((".", " ")) or part.startswith(" ") or part.split(".")[0].casefold() in _DEVICES:
            return "a name in it means something else on other systems"
        if len(part.encode()) > LONGEST_NAME:
            return f"a name in it is longer than {LONGEST_NAME} bytes"
    folded = fold(path)
    if folded.endswith(_PICKLES):
        return "a pickle runs code when it is read; weights are kept as .safetensors"
    if folded.endswith(_CODE):
        return "it is code, and nothing from a remote is ever run"
    return ""


def journals_of(root: Path) -> Path:
    """Return the folder of a dataset's journals, beside it."""
    return root.absolute().with_name(f"{root.absolute().name}.{JOURNALS}")


def newest(checkpoints: Path) -> str | None:
    """Return the name of the checkpoint with the highest step."""
    steps = [path.name for path in checkpoints.iterdir() if path.name.isdecimal() and path.is_dir()]
    return max(steps, key=int, default=None)


def policy_folder(paths: Iterable[str]) -> str | None:
    """Return the folder of a run's policy among its files' `paths`: empty for the root, None without a policy.

    The best one, if the run has chosen it; else that of the newest checkpoint.
    """
    folders = {path.rpartition("/")[0] for path in paths if path.rpartition("/")[2] == CONFIG}
    for folder in _POLICY_FOLDERS:
        if folder in folders:
            return folder
    steps = {folder: int(found[1]) for folder in folders if (found := _CHECKPOINT.fullmatch(folder))}
    return max(steps, key=lambda folder: steps[folder], default=None)


def without_root_copies(manifest: Manifest) -> Manifest:
    """Return a run without the copies at its root, if all are there with the same bytes."""
    inside, there = policy_files(manifest), manifest.by_path
    if any(name not in there or there[name].key != entry.key for name, entry in inside.items()):
        return manifest
    return replace(manifest, files=tuple(entry for entry in manifest.files if entry.path not in inside))


def policy_files(manifest: Manifest) -> Mapping[str, FileEntry]:
    """Return name -> file of a run's policy; empty for a dataset, and for a policy that is at the root alone."""
    if manifest.kind != "policy":
        return {}
    folder = policy_folder(path for path in manifest.by_path if path != CONFIG)
    if folder is None:
        return {}
    start = f"{folder}/"
    inside = {path.removeprefix(start): entry for path, entry in manifest.by_path.items() if path.startswith(start)}
    return {name: entry for name, entry in inside.items() if "/" not in name and name != CARD}
