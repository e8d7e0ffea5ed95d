"""What a policy must be shown: the cameras that its checkpoint was trained with, drawn as they were then."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.learn.checkpoint import META_FILE, read_meta
from manip_il.learn.pretrained import read_interface
from manip_il.sim.look import CAMERAS, CameraConfig, Look

if TYPE_CHECKING:
    from manip_il.engine.jobs import RolloutJob


def policy_cameras(policy: Path) -> CameraConfig | None:
    """Cameras, size and look of the pictures that a checkpoint looks at; None for one that looks at none.

    The light is the default where the checkpoint does not say. Raises `MismatchError` for cameras that environments do
    not have or whose pictures differ in size, `ManipError` for a folder or a size that cannot be.
    """
    pictures, meta = read_interface(policy).pictures, read_meta(policy)
    if not pictures:
        return None
    if not set(pictures) <= set(CAMERAS):
        raise MismatchError("cameras", str(policy), ", ".join(pictures), "the environment", ", ".join(CAMERAS))
    if len(set(pictures.values())) > 1:
        sizes = ", ".join(f"{camera} {size}" for camera, size in pictures.items())
        raise MismatchError("size of pictures", str(policy), sizes, "the environment", "one size for all cameras")
    as_recorded = meta is not None and set(meta.cameras) == set(pictures)
    names = meta.cameras if meta is not None and as_recorded else tuple(pictures)
    height, width = next(iter(pictures.values()))
    try:
        return CameraConfig(names, height, width, Look(**(meta.look or {}) if meta else {}))
    except (UsageError, TypeError) as error:
        raise ManipError(f"{policy}: its pictures cannot be rendered ({error}); see its {META_FILE}") from error


def drawn_cameras(job: RolloutJob) -> CameraConfig | None:
    """What the environments of a job draw: what is recorded, else what its policy looks at.

    Raises `MismatchError` where the policy would not find its pictures among the recorded ones.
    """
    wanted = policy_cameras(job.policy) if job.policy is not None else None
    if wanted is None or job.cameras is None:
        return job.cameras or wanted
    if not set(wanted.names) <= set(job.cameras.names):
        raise MismatchError("cameras", str(job.policy), wanted.names, "the recording", job.cameras.names)
    if wanted.size != job.cameras.size:
        raise MismatchError("size of pictures", str(job.policy), wanted.size, "the recording", job.cameras.size)
    return job.cameras
