"""Checkpoints of a run in LeRobot's layout: written whole or not at all, and gone on from.

    OUTPUT/checkpoints/004000/pretrained_model/   config.json model.safetensors policy_*processor*.json|safetensors
                                                  train_config.json manip_il.json
                             /training_state/     optimizer_*.safetensors|json scheduler_state.json
                                                  rng_state.safetensors training_step.json
    OUTPUT/checkpoints/last -> 004000

A checkpoint is written under a temporary name and `last` is switched over in one rename, so that a kill leaves the one
before. A run goes on with `lerobot-train --config_path=.../pretrained_model/train_config.json --resume=true`, too.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.data.atomic import writing
from manip_il.errors import FolderExistsError, ManipError
from manip_il.learn.checkpoint import META_FILE, Origin

PRETRAINED_MODEL, TRAINING_STATE, STEP_FILE = "pretrained_model", "training_state", "training_step.json"
_LAST = "last"


def last_checkpoint(output_dir: Path, *, resume: bool) -> Path | None:
    """Return the folder `checkpoints/last` to go on from, or None if there is none.

    Raises `FolderExistsError` if there is one, unless `resume`.
    """
    last = output_dir / "checkpoints" / _LAST
    if not (last / PRETRAINED_MODEL).is_dir():
        return None
    if not resume:
        raise FolderExistsError(output_dir)
    return last


def read_step(checkpoint: Path) -> dict[str, Any]:
    """Return the step and the resume key of a checkpoint folder. Raises `ManipError` if it has none."""
    path = checkpoint / TRAINING_STATE / STEP_FILE
    if not path.is_file():
        raise ManipError(f"no {path}: this checkpoint cannot be resumed; use it as init_from instead")
    values = checks.read_json(path, "the step of a run")
    checks.whole(f"{path}: step", values.get("step"), 0, 10**12)
    return values


@contextmanager
def readable_state(checkpoint: Path) -> Iterator[None]:
    """Turn what LeRobot, torch and safetensors raise for files that are not whole into `ManipError`."""
    try:
        yield
    except ManipError:
        raise
    except Exception as error:  # of every kind: files of tensors and JSON, read by others' code
        line = checks.shorten(checks.one_line(error))
        raise ManipError(
            f"{checkpoint} cannot be resumed ({type(error).__name__}: {line}); start again with --overwrite=true"
        ) from error


@contextmanager
def unpublished(final: Path) -> Generator[Path]:
    """Give an empty folder to write a checkpoint into; on leaving, it gets its name and is `last`.

    An exception removes it. Raises `WriteError` if the disk is full or read-only.
    """
    temporary = final.parent / f".{final.name}.tmp"
    try:
        with writing(final):
            final.parent.mkdir(parents=True, exist_ok=True)
            for stale in (temporary, final):  # of a run that was killed before it could switch `last` over
                shutil.rmtree(stale, ignore_errors=True)
            temporary.mkdir()
            yield temporary
            for path in temporary.rglob("*.safetensors"):  # hidden from other users, a container's among them
                path.chmod(temporary.stat().st_mode & 0o666)
            temporary.rename(final)
            link = final.parent / ".last.tmp"
            link.unlink(missing_ok=True)
            link.symlink_to(final.name)
            os.replace(link, final.parent / _LAST)  # in one rename
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_own_files(checkpoint: Path, origin: Origin, step: Mapping[str, Any]) -> None:
    """Write what LeRobot's checkpoints have not: the origin, and the step with the resume key."""
    for path, values in (
        (f"{PRETRAINED_MODEL}/{META_FILE}", origin.to_json()),
        (f"{TRAINING_STATE}/{STEP_FILE}", step),
    ):
        (checkpoint / path).write_text(json.dumps(values, indent=2) + "\n")
