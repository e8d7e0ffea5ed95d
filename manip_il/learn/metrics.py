"""Where a fit's metrics go: always a file of JSON lines; TensorBoard and Weights & Biases on request."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot.configs.train import TrainPipelineConfig

from manip_il.data.atomic import write_file
from manip_il.data.writing import writing
from manip_il.errors import UsageError

METRICS_FILE = "metrics.jsonl"
Record = Mapping[str, Any]  # `step` and numbers
Writer = Callable[[Record], None]


@contextmanager
def json_lines(path: Path, step: int) -> Iterator[Writer]:
    """A function that adds a line; lines after `step`, of a run that was killed, go first."""
    kept = []
    if path.is_file() and step > 0:
        for line in path.read_text().splitlines():
            with_step = _step_of(line)
            if with_step is not None and with_step <= step:
                kept.append(line + "\n")
    write_file(path, "".join(kept).encode())

    def write(record: Record) -> None:
        with writing(path), path.open("ab") as file:
            file.write((json.dumps(dict(record)) + "\n").encode())

    yield write


@contextmanager
def tensorboard(folder: Path, step: int) -> Iterator[Writer]:
    """A function that adds a point to every curve. Raises `UsageError` where TensorBoard is not installed."""
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
    """A function that adds a point, through LeRobot's own logger."""
    from lerobot.common.wandb_utils import WandBLogger

    logger = WandBLogger(config)
    yield lambda record: logger.log_dict({k: v for k, v in record.items() if k != "step"}, record["step"])


def _step_of(line: str) -> int | None:
    try:
        return int(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return None  # cut short by a kill
