"""What the files of a policy's folder say of it: by which hash it is known, and which pictures it must be shown."""

from __future__ import annotations

import hashlib
from pathlib import Path

from manip_il.errors import ManipError, UsageError
from manip_il.learn.checkpoint import META_FILE, Checkpoint
from manip_il.sim.config import CameraConfig, Look

_FOR_PEOPLE = ("README.md", "train_config.json")  # beside a policy, and no part of how it acts


def policy_sha256(policy: Path) -> str:
    """Return the SHA-256 of everything in a policy's folder that decides how it acts, but not of where it lies."""
    digest = hashlib.sha256()
    for path in sorted(policy.iterdir()):
        if path.is_file() and path.name not in _FOR_PEOPLE:
            digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def policy_cameras(policy: Path) -> CameraConfig | None:
    """Return cameras, size and light of the pictures that a checkpoint was trained with; None for one without.

    The light is the default if the checkpoint does not say. Raises `ManipError` for cameras that environments do not
    have, and for a folder or a size that cannot be.
    """
    checkpoint = Checkpoint.open(policy)
    pictures, meta = checkpoint.pictures, checkpoint.origin
    if not pictures:
        return None
    as_recorded = meta is not None and set(meta.cameras) == set(pictures)
    names = meta.cameras if meta is not None and as_recorded else tuple(pictures)
    height, width = next(iter(pictures.values()))
    try:
        return CameraConfig(names, height, width, Look(**(meta.look or {}) if meta else {}))
    except (UsageError, TypeError) as error:
        raise ManipError(f"{policy}: its pictures cannot be rendered ({error}); see its {META_FILE}") from error
