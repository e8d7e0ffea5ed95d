"""Checkpoints written by LeRobot's own function, with our two files beside, and switched over in one rename.

    OUTPUT/checkpoints/020000/pretrained_model/   config.json model.safetensors train_config.json README.md
                                                  policy_*processor*.json|safetensors manip_il.json
                             /training_state/     optimizer, scheduler, random state, training_step.json
    OUTPUT/checkpoints/last -> 020000

`lerobot-train --config_path=OUTPUT/checkpoints/last/pretrained_model/train_config.json --resume=true` goes on from it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lerobot.common.train_utils import get_step_checkpoint_dir, save_checkpoint
from lerobot.configs.train import TrainPipelineConfig

from manip_il.learn.checkpoint import (
    META_FILE,
    PRETRAINED_MODEL,
    STEP_FILE,
    TRAINING_STATE,
    CheckpointMeta,
    read_step,
    unpublished,
    write_json,
)


@dataclass(frozen=True)
class Progress:
    """Where a run is, and what a run that goes on from here must share with it."""

    step: int
    steps: int
    data: str
    options: Mapping[str, Any]


@contextmanager
def save_lerobot_checkpoint(
    output_dir: Path,
    progress: Progress,
    parts: tuple[Any, Any, Any],
    state: tuple[Any, Any],
    pipeline: TrainPipelineConfig,
    meta: CheckpointMeta,
) -> Iterator[Path]:
    """Write the checkpoint of a step and make it `last` when the block ends, which may add files to the given folder.

    parts: policy, preprocessor, postprocessor. state: optimiser and scheduler. The given folder is the future
    `pretrained_model`.
    """
    final = get_step_checkpoint_dir(output_dir, progress.steps, progress.step)
    policy, before, after = parts
    optimizer, scheduler = state
    with unpublished(final) as temporary:
        save_checkpoint(temporary, progress.step, pipeline, policy, optimizer, scheduler, before, after)
        write_json(temporary / PRETRAINED_MODEL / META_FILE, asdict(meta))
        key = {"data": progress.data, "options": progress.options, "batch_size": pipeline.batch_size}
        write_json(temporary / TRAINING_STATE / STEP_FILE, read_step(temporary) | key)
        yield temporary / PRETRAINED_MODEL
