"""Choose whether a fit's numbers are kept in memory or in files, by `--memory`."""

from __future__ import annotations

from pathlib import Path

from manip_il.data.arrays import Allocate, in_memory, on_disk
from manip_il.data.schema import RobotTaskSpec
from manip_il.errors import UsageError
from manip_il.learn.fit_config import FitConfig

_COPIES = 3  # of a frame's numbers: as stored, as learnt from, in the network's units


def numbers_of(spec: RobotTaskSpec) -> int:
    """Return how many numbers of a frame the mlp learns from: what is observed, and the action."""
    return 2 * len(spec.joint_names) + len(spec.environment_state_names)


def room(config: FitConfig, folder: Path, frames: int, numbers: int, batch_bytes: int = 0) -> Allocate:
    """Return what makes the arrays of a fit to so many frames of so many numbers each, in files of `folder` if need be.

    batch_bytes: what a batch takes, by default its frames alone. Raises `UsageError` for less memory than that.
    """
    if config.memory is None:
        return in_memory
    frame, given = 4 * numbers, config.memory * 1e9
    batch = batch_bytes or config.samples_per_step * frame
    if given < batch:
        raise UsageError(
            f"memory is {config.memory:g} GB; a batch of {config.samples_per_step:,} samples takes "
            f"{batch / 1e9:.2g} GB: give more, or a smaller --batch_size"
        )
    return in_memory if _COPIES * frame * frames <= given else on_disk(folder)
