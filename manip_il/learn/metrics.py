"""Metrics of a fit: always a file of JSON lines; TensorBoard and Weights & Biases on request."""

from __future__ import annotations

import functools
import importlib
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from lerobot.configs.train import TrainPipelineConfig

from manip_il.data.atomic import write_file
from manip_il.data.json_lines import Record, append_line, read_lines
from manip_il.errors import UsageError

METRICS_FILE, TENSORBOARD_FOLDER = "metrics.jsonl", "tensorboard"
Writer = Callable[[Record], None]


@contextmanager
def metric_writers(output_dir: Path, step: int, curves: bool, pipeline: TrainPipelineConfig) -> Iterator[list[Writer]]:
    """Give the functions to call with each record: of the file of lines, and of what else the user asked for.

    step: the fit goes on from there. curves: for TensorBoard. pipeline: with the options for Weights & Biases. Raises
    `UsageError` if one of them is not installed.
    """
    output_dir.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        writers = [json_lines(output_dir / METRICS_FILE, step)]
        if curves:
            writers.append(stack.enter_context(tensorboard(output_dir / TENSORBOARD_FOLDER, step)))
        if pipeline.wandb.enable:
            pipeline.resume = step > 0
            writers.append(weights_and_biases(pipeline))
        yield writers


def json_lines(path: Path, step: int) -> Writer:
    """Return a function that adds a line, null if a number is not finite; lines after `step` are dropped first."""
    kept = [record for record in read_lines(path) if record["step"] <= step] if step > 0 else []
    write_file(path, "".join(f"{json.dumps(record)}\n" for record in kept).encode())
    return functools.partial(append_line, path)


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


def weights_and_biases(config: TrainPipelineConfig) -> Writer:
    """Return a function that adds a point by LeRobot's own logger. Raises `UsageError` if wandb is not installed."""
    try:
        importlib.import_module("wandb")  # LeRobot's logger imports it, and says less
        from lerobot.common.wandb_utils import WandBLogger
    except ImportError as error:
        raise UsageError("--wandb.enable=true needs Weights & Biases: pip install wandb") from error
    logger = WandBLogger(config)
    return lambda record: logger.log_dict({k: v for k, v in record.items() if k != "step"}, record["step"])
