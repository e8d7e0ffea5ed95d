"""Which paths a manifest may hold: those that mean one file inside the target folder, on any system, and no code."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable

from manip_il.store.errors import ManifestError

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


def check_path(path: object) -> str:
    """`path` where it is allowed; else raise `ManifestError` with the reason."""
    if not isinstance(path, str):
        raise ManifestError(f"a manifest names a file {path!r:.80}; expected a string")
    if reason := _reason(path):
        raise ManifestError(f"the file {path!r:.200} is refused: {reason}")
    return path


def check_together(paths: Iterable[str]) -> None:
    """Raise `ManifestError` where two paths are one on some system, or one is both file and folder."""
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
    """What a file system may see in a path that knows no upper case and one way to code each letter."""
    return unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", path).casefold())


def is_hidden(path: str) -> bool:
    """Return whether a name in the path begins with a dot: no push takes such files along, and no pull makes them."""
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
    return _code_reason(fold(path))


def _code_reason(folded: str) -> str:
    if folded.endswith(_PICKLES):
        return "a pickle runs code when it is read; weights are kept as .safetensors"
    if folded.endswith(_CODE):
        return "it is code, and nothing from a remote is ever run"
    return ""
