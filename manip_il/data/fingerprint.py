"""Differences between fingerprints of environments, and the hash of a policy."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from manip_il import checks

_HASH = 12  # printed characters of a hash
_LONGEST = 80  # printed characters of any other value
# saved beside a policy, but not part of how it acts
_FOR_PEOPLE = ("README.md", "train_config.json")


def compare_fingerprints(
    left_name: str, left: Mapping[str, Any], right_name: str, right: Mapping[str, Any]
) -> list[str]:
    """Compare the fingerprints of two environments.

    Args:
        left_name: Name of the first side, for the warnings.
        left: Its fingerprint.
        right_name: Name of the second side, for the warnings.
        right: Its fingerprint.

    Returns:
        One warning, naming both sides, for every entry that differs or that only one side has.
    """
    warnings: list[str] = []
    for key in dict.fromkeys([*left, *right]):
        ours, theirs = left.get(key, "nothing"), right.get(key, "nothing")
        if ours != theirs:
            most = _HASH if key.endswith("_sha256") else _LONGEST
            sides = f"{left_name} has {str(ours)[:most]}, {right_name} has {str(theirs)[:most]}"
            warnings.append(f"{key} differs: {sides}")
    return warnings


def file_sha256(path: Path) -> bytes:
    """Return the SHA-256 of a file's content. Raises `ManipError` if it cannot be opened."""
    with checks.open_outside(path, "a file") as file:
        return hashlib.file_digest(file, "sha256").digest()


def policy_sha256(policy: Path) -> str:
    """Return the SHA-256 of everything in a policy's folder that decides how it acts,
    independent of its path.
    """
    digest = hashlib.sha256()
    for path in sorted(policy.iterdir()):
        if path.is_file() and path.name not in _FOR_PEOPLE:
            digest.update(path.name.encode() + b"\0" + file_sha256(path))
    return digest.hexdigest()
