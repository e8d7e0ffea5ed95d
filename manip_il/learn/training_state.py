"""A run's metrics, and its checkpoints in LeRobot's layout: how they are written, atomically, and
resumed from.

    OUTPUT/metrics.jsonl, OUTPUT/tensorboard
    OUTPUT/checkpoints/004000/pretrained_model/   config.json manip_il.json model.safetensors
                                                  policy_*processor*.json|safetensors
                                                  train_config.json
                             /training_state/     optimizer_*.safetensors|json rng_state.safetensors
                                                  scheduler_state.json training_step.json
    OUTPUT/checkpoints/last -> 004000

A checkpoint is written under a temporary name and `last` is switched over by one rename, so that a
killed run keeps the previous one. `lerobot-train
--config_path=.../pretrained_model/train_config.json --resume=true` can also resume a run.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from manip_il.data.atomic import CHECKPOINT, Record, append_line, new_folder, read_lines, write_file
from manip_il.errors import FolderExistsError, requires

if TYPE_CHECKING:  # LeRobot takes seconds to import
    from lerobot.configs.train import TrainPipelineConfig

PRETRAINED_MODEL = "pretrained_model"
METRICS_FILE, TENSORBOARD_FOLDER = "metrics.jsonl", "tensorboard"
Writer = Callable[[Record], None]


def last_checkpoint(output_dir: Path, *, resume: bool) -> Path | None:
    """Return the folder `checkpoints/last` to resume from, or None if there is none.

    Args:
        output_dir: The folder of the run.
        resume: Whether to continue from a checkpoint that is there.

    Raises:
        FolderExistsError: There is a checkpoint, and `resume` is not set.
    """
    last = output_dir / "checkpoints/last"
    if not (last / PRETRAINED_MODEL).is_dir():
        return None
    if not resume:
        raise FolderExistsError(output_dir)
    return last


@contextmanager
def new_checkpoint(final: Path) -> Generator[Path]:
    """Yield an empty folder to write a checkpoint into.

    On exit it is renamed to `final` and becomes `last`. After an exception it is removed.

    Raises:
        ManipError: The disk is full or read-only.
    """
    # replaces the folder of a run killed before it switched `last`
    with new_folder(final, replaces=CHECKPOINT) as new:
        yield new
        # without this, other users, such as a container's, could not read them
        for path in new.rglob("*.safetensors"):
            path.chmod(new.stat().st_mode & 0o666)
    link = final.parent / ".last.tmp"
    link.unlink(missing_ok=True)
    link.symlink_to(final.name)
    os.replace(link, final.parent / "last")  # in one rename


def metric_writers(
    output_dir: Path, step: int, curves: bool, pipeline: TrainPipelineConfig
) -> list[Writer]:
    """Return functions to call with each record, which write it to the metrics file and other
    requested outputs.

    Args:
        output_dir: The folder of the run.
        step: Steps already taken.
        curves: Whether to write to TensorBoard.
        pipeline: LeRobot's options, among them those of Weights & Biases.

    Raises:
        ManipError: TensorBoard is not installed.
    """
    writers = [json_lines(output_dir / METRICS_FILE, step)]
    if curves:
        writers.append(_tensorboard(output_dir / TENSORBOARD_FOLDER, step))
    if pipeline.wandb.enable:
        pipeline.output_dir, pipeline.resume = output_dir, step > 0
        writers.append(_weights_and_biases(pipeline))
    return writers


def json_lines(path: Path, step: int) -> Writer:
    """Drop the lines of a metrics file after a step, and return a function that appends a line.

    The function writes null for numbers that are not finite.

    Args:
        path: The metrics file.
        step: Steps already taken; with 0 all lines are dropped.
    """
    kept = [record for record in read_lines(path) if record["step"] <= step] if step > 0 else []
    write_file(path, "".join(f"{json.dumps(record)}\n" for record in kept).encode())
    return functools.partial(append_line, path)


def _tensorboard(folder: Path, step: int) -> Writer:
    """Return a function that adds a record's numbers to TensorBoard's curves."""
    with requires("--tensorboard=true", "'manip_il[tensorboard]'"):
        from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(folder), purge_step=step + 1 if step else None)

    def write(record: Record) -> None:
        for name, value in record.items():
            writer.add_scalar(name, value, record["step"])
        writer.flush()

    return write


def _weights_and_biases(config: TrainPipelineConfig) -> Writer:
    """Return a function that logs a record with LeRobot's own logger."""
    from lerobot.common.wandb_utils import WandBLogger  # which imports LeRobot

    logger = WandBLogger(config)
    return lambda record: logger.log_dict(dict(record), record["step"])
