"""Metrics of a fit: always a file of JSON lines; TensorBoard and Weights & Biases on request."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from lerobot.configs.train import TrainPipelineConfig

from manip_il import checks
from manip_il.data.atomic import write_file, writing
from manip_il.errors import UsageError

METRICS_FILE, TENSORBOARD_FOLDER = "metrics.jsonl", "tensorboard"
Record = Mapping[str, Any]  # `step` and numbers
Writer = Callable[[Record], None]


@contextmanager
def metric_writers(output_dir: Path, step: int, curves: bool, pipeline: TrainPipelineConfig) -> Iterator[list[Writer]]:
    """Give the functions to call with each record: of the file of lines, and of what else the user asked for.

    step: the fit goes on from there. curves: for TensorBoard. pipeline: with the options for Weights & Biases. Raises
    `UsageError` if one of them is not installed.
    """
    with writing(output_dir):
        output_dir.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        writers = [stack.enter_context(json_lines(output_dir / METRICS_FILE, step))]
        if curves:
            writers.append(stack.enter_context(tensorboard(output_dir / TENSORBOARD_FOLDER, step)))
        if pipeline.wandb.enable:
            pipeline.resume = step > 0
            writers.append(stack.enter_context(weights_and_biases(pipeline)))
        yield writers


@contextmanager
def json_lines(path: Path, step: int) -> Iterator[Writer]:
    """Give a function that adds a line, null if a number is not finite; lines after `step` are dropped first."""
    lines = path.read_text(errors="replace").splitlines() if step > 0 and path.is_file() else []
    write_file(path, "".join(f"{line}\n" for line in lines if _is_until(step, line)).encode())

    def write(record: Record) -> None:
        with writing(path), open(path, "ab", opener=checks.without_link) as file:
            finite = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in record.items()}
            file.write((json.dumps(finite, allow_nan=False) + "\n").encode())

    yield write


@contextmanager
def tensorboard(folder: Path, step: int) -> Iterator[Writer]:
    """Give a function that adds a point to every curve. Raises `UsageError` if TensorBoard is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise UsageError("--tensorboard=true needs TensorBoard: pip install 'manip_il[tensorboard]'") from error
    with SummaryWriter(str(folder), purge_step=step + 1 if step else None) as writer:

        def write(record: Record) -> None:
            for name, value in record.items():
                if name != "step":
                    writer.add_scalar(name, value, record["step"])
            writer.flush()

        yield write


@contextmanager
def weights_and_biases(config: TrainPipelineConfig) -> Iterator[Writer]:
    """Give a function that adds a point by LeRobot's own logger. Raises `UsageError` if wandb is not installed."""
    try:
        importlib.import_module("wandb")  # LeRobot's logger imports it, and says less
        from lerobot.common.wandb_utils import WandBLogger
    except ImportError as error:
        raise UsageError("--wandb.enable=true needs Weights & Biases: pip install wandb") from error
    logger = WandBLogger(config)
    yield lambda record: logger.log_dict({k: v for k, v in record.items() if k != "step"}, record["step"])


def _is_until(step: int, line: str) -> bool:
    """Whether a line is of a step up to this one; a line that a kill cut short is of none."""
    try:
        return json.loads(line)["step"] <= step
    except (ValueError, KeyError, TypeError):
        return False
