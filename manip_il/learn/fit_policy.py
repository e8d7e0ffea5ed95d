"""Behaviour cloning with any policy of LeRobot's: its optimiser, its processors, its checkpoints, our data paths.

The mlp has a loop of its own, in `manip_il.learn.train`, which says why.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs
from lerobot.common.train_utils import load_training_state
from lerobot.utils.random_utils import set_seed
from numpy.typing import NDArray

from manip_il.data.lerobot_library import read_metadata
from manip_il.errors import FolderExistsError, NotFiniteError, UsageError
from manip_il.learn.card import write_card
from manip_il.learn.checkpoint import (
    PRETRAINED_MODEL,
    CheckpointMeta,
    check_same_run,
    last_checkpoint,
    read_step,
    readable_state,
)
from manip_il.learn.lerobot_checkpoint import Progress, save_lerobot_checkpoint
from manip_il.learn.metrics import Writer, metric_writers
from manip_il.learn.order import batches_of, order_of
from manip_il.learn.policy_config import PolicyFitConfig
from manip_il.learn.prefetch import prefetched
from manip_il.learn.setup import Samples, build_policy, build_processors, load_samples, set_features
from manip_il.learn.sources import Batch, pictures_to_float
from manip_il.learn.threads import threads

F64, I64 = NDArray[np.float64], NDArray[np.int64]
_HALF_PRECISION = {"bfloat16": "bf16", "float16": "fp16"}


def fit_policy(
    root: Path | Sequence[Path],
    config: PolicyFitConfig,
    output_dir: Path,
    *,
    meta: CheckpointMeta,
    on_step: Callable[[dict[str, Any]], None] | None = None,
    on_frames: Callable[[int], None] | None = None,
    resume: bool = False,
    weights: F64 | None = None,
) -> Path:
    """Clone the labels of the dataset in `root`, or of several; return `output_dir/checkpoints/last/pretrained_model`.

    meta: what the policy is trained for. weights: how often each frame is drawn, relative to the others, (N,); by
    default each once an epoch. on_step: called after every step, with the metrics where there are some,
    else with {}; an exception from it ends the fit, `KeyboardInterrupt` after a checkpoint. on_frames: sees how many
    frames more have been decoded into the cache. On one CPU the same data, config and threads give the same bits,
    resumed or not. Started by `accelerate launch` or `torchrun`, every process takes `batch_size` samples a step.

    Raises `FolderExistsError` for a folder with a checkpoint unless `resume`, `MismatchError` for a run that is
    resumed on other data or options, `NotFiniteError` for data or a loss that is not finite, and what the policy
    refuses as `ManipError`.
    """
    with threads(config.threads):
        trainer = PolicyTrainer(root, config, output_dir, meta, resume=resume, on_frames=on_frames, weights=weights)
        return trainer.fit(on_step)


class PolicyTrainer:
    """Policy, processors, optimiser and data of one run; `run()` yields once a step."""

    def __init__(
        self,
        root: Path | Sequence[Path],
        config: PolicyFitConfig,
        output_dir: Path,
        meta: CheckpointMeta,
        *,
        resume: bool = False,
        on_frames: Callable[[int], None] | None = None,
        weights: F64 | None = None,
    ):
        self.config, self.output_dir, self.meta = config, output_dir, meta
        self.accelerator = _accelerator(config)
        self.accelerator.wait_for_everyone()  # the first process may have had a folder to empty
        checkpoint = last_checkpoint(output_dir)
        if checkpoint is not None and not resume:
            raise FolderExistsError(output_dir)
        roots = [root] if isinstance(root, Path) else list(root)
        self.dataset = read_metadata(*roots)
        set_features(config.policy, self.dataset, config.observation)
        self.options = config.what_changes_the_weights()
        with self.accelerator.main_process_first():  # it fills the cache, the others find it full
            self.samples: Samples = load_samples(roots, config, self.dataset, on_frames)
        self.digest = _digest(self.samples.digest, weights)
        if checkpoint is not None:
            check_same_run(checkpoint, self.digest, self.options)
        self.pipeline = config.lerobot(self.dataset.repo_id, str(roots[-1]), output_dir)
        self.step = 0
        self._build(checkpoint)
        world = self.accelerator.num_processes
        drawn = weights[self.samples.train] if weights is not None else None
        self._order = order_of(len(self.samples.train), drawn, config.batch_size * world, config.seed)

    def _build(self, checkpoint: Path | None) -> None:
        config = self.config
        set_seed(config.seed)
        if checkpoint is not None:
            config.policy.pretrained_path = checkpoint / PRETRAINED_MODEL
        policy = build_policy(config.policy, self.dataset)
        before = checkpoint / PRETRAINED_MODEL if checkpoint is not None else None
        self.preprocessor, self.postprocessor = build_processors(
            config.policy, self.dataset, before, trust=config.trust
        )
        optimizer = config.resolved_optimizer().build(policy.get_optim_params())
        if not isinstance(optimizer, torch.optim.Optimizer):
            raise UsageError(
                f"--policy.type={config.policy.type} needs several optimisers; train it with lerobot-train"
            )
        schedule = config.resolved_scheduler()
        scheduler = schedule.build(optimizer, config.steps) if schedule is not None else None
        if checkpoint is not None:
            read_step(checkpoint)
            with readable_state(checkpoint):
                self.step, optimizer, scheduler = load_training_state(checkpoint, optimizer, scheduler)
        self.policy, self.optimizer, self.scheduler = self.accelerator.prepare(policy, optimizer, scheduler)

    def fit(self, on_step: Callable[[dict[str, Any]], None] | None = None) -> Path:
        """Take the steps that are left, with metrics and checkpoints; see `fit_policy`."""
        config = self.config
        with self._open_metrics() as writers:
            for record in self.run():
                for write in writers if record else []:
                    write(record)
                saved = self.step % config.save_freq == 0 or self.step == config.steps
                if saved:
                    self.save(record)
                try:
                    if on_step is not None:
                        on_step(record)
                except KeyboardInterrupt:  # asked for between two steps: nothing is lost
                    if not saved:
                        self.save(record)
                    raise
        self.accelerator.end_training()
        return self.output_dir / "checkpoints" / "last" / PRETRAINED_MODEL

    def run(self) -> Iterator[dict[str, Any]]:
        """Take the steps that are left; yield the metrics at every `log_freq` and the last, else {}."""
        config, log = self.config, _Log(self.config.batch_size * self.accelerator.num_processes)
        batches = self.samples.source.batches(self._rows_of(step) for step in itertools.count(self.step))
        self.policy.train()
        with prefetched(itertools.islice(batches, config.steps - self.step)) as ready:
            while self.step < config.steps:
                started = time.perf_counter()
                batch = next(ready)
                waited = time.perf_counter() - started
                log.add(self._update(batch), waited)
                self.step += 1
                if self.step % config.log_freq and self.step != config.steps:
                    yield {}
                    continue
                yield {"step": self.step, **log.take(), "lr": self._lr()} | self.validate()

    def validate(self) -> dict[str, float]:
        """Return mean loss on samples of the held-out episodes, without touching the training's random state."""
        held_out = self.samples.held_out
        if len(held_out) == 0 or not self.accelerator.is_main_process:
            return {}
        policy = self.accelerator.unwrap_model(self.policy)
        policy.eval()
        total = 0.0
        with torch.no_grad(), torch.random.fork_rng(), self.accelerator.autocast():
            torch.manual_seed(self.config.seed)  # a policy that draws (diffusion) draws the same every time
            pieces = batches_of(held_out, self.config.batch_size)
            for rows, batch in zip(pieces, self.samples.source.batches(pieces), strict=True):
                loss, _ = policy.forward(self.preprocessor(pictures_to_float(batch, self.samples.cameras)))
                total += loss.item() * len(rows)
        policy.train()
        return {"val_loss": total / len(held_out)}

    def save(self, record: Mapping[str, Any]) -> None:
        """Write a checkpoint of this step and make it the last one. record: metrics for the model card."""
        if self.accelerator.is_main_process:
            progress = Progress(self.step, self.config.steps, self.digest, self.options)
            parts = (self.accelerator.unwrap_model(self.policy), self.preprocessor, self.postprocessor)
            state = (self.optimizer, self.scheduler)
            with save_lerobot_checkpoint(self.output_dir, progress, parts, state, self.pipeline, self.meta) as folder:
                write_card(folder, self.pipeline, self.meta, self.dataset, record)
        self.accelerator.wait_for_everyone()

    def _open_metrics(self) -> contextlib.AbstractContextManager[list[Writer]]:
        """Where metrics go, in the main process."""
        if not self.accelerator.is_main_process:
            return contextlib.nullcontext([])
        return metric_writers(self.output_dir, self.step, self.config.tensorboard, self.pipeline)

    def _update(self, batch: Batch) -> dict[str, float]:
        batch = self.preprocessor(self._augmented(batch))
        with self.accelerator.autocast():
            loss, outputs = self.policy.forward(batch)
        value = loss.item()
        if not math.isfinite(value):
            raise NotFiniteError(f"the loss is {value} at step {self.step}; lower the learning rate ({self._lr():g})")
        self.accelerator.backward(loss)
        norm = self.accelerator.clip_grad_norm_(self.policy.parameters(), self._clip())
        self.optimizer.step()
        self.optimizer.zero_grad()
        if self.scheduler is not None:
            self.scheduler.step()
        unwrapped = self.accelerator.unwrap_model(self.policy)
        if callable(update := getattr(unwrapped, "update", None)):
            update()  # averages of weights and the like, as lerobot-train calls it
        numbers = {k: float(v) for k, v in (outputs or {}).items() if isinstance(v, int | float)}
        return numbers | {"loss": value, "grad_norm": math.nan if norm is None else float(norm)}

    def _augmented(self, batch: Batch) -> Batch:
        """Pictures on the device, shifted and recoloured by draws that depend on seed, step and process alone."""
        cameras = self.samples.cameras
        if not cameras:
            return batch
        device = self.accelerator.device
        batch = batch | {key: batch[key].to(device, non_blocking=True) for key in cameras}
        if self.config.augment is None or batch[cameras[0]].dtype != torch.uint8:
            return pictures_to_float(batch, cameras)
        key = [self.config.seed, self.step, self.accelerator.process_index]
        generator = torch.Generator().manual_seed(int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0] >> 1))
        return batch | {camera: self.config.augment(batch[camera], generator) for camera in cameras}

    def _rows_of(self, step: int) -> I64:
        """The samples of this process at a step."""
        size, place = self.config.batch_size, self.accelerator.process_index
        rows = self._order.batch(step).numpy()[place * size : (place + 1) * size]
        return self.samples.train[rows]

    def _lr(self) -> float:
        return float(self.optimizer.param_groups[0]["lr"])

    def _clip(self) -> float:
        norm = self.config.resolved_optimizer().grad_clip_norm
        return norm if norm > 0 else math.inf


def _digest(samples: str, weights: F64 | None) -> str:
    return samples if weights is None else hashlib.sha256(samples.encode() + weights.tobytes()).hexdigest()


class _Log:
    """Means since the last record."""

    def __init__(self, batch_size: int):
        self._batch_size = batch_size
        self._start()

    def _start(self) -> None:
        self._sums: dict[str, float] = {}
        self._steps, self._waited, self._started = 0, 0.0, time.perf_counter()

    def add(self, numbers: Mapping[str, float], waited: float) -> None:
        for name, value in numbers.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._steps += 1
        self._waited += waited

    def take(self) -> dict[str, float]:
        """Return the means, the samples a second, and the share of the time that was spent waiting for data."""
        seconds = max(time.perf_counter() - self._started, 1e-9)
        means = {name: total / self._steps for name, total in self._sums.items()}
        rates = {
            "samples_per_s": round(self._steps * self._batch_size / seconds, 1),
            "data_share": round(self._waited / seconds, 4),
        }
        self._start()
        return means | rates


def _accelerator(config: PolicyFitConfig) -> Accelerator:
    """As lerobot-train makes it: half precision by the policy's `dtype`, else by its `use_amp`."""
    precision = _HALF_PRECISION.get(getattr(config.policy, "dtype", None) or "", "no")
    if not hasattr(config.policy, "dtype") and config.policy.use_amp:
        precision = "bf16" if config.policy.device == "cpu" else "fp16"
    return Accelerator(
        step_scheduler_with_optimizer=False,
        mixed_precision=precision,
        cpu=config.policy.device == "cpu",
        kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=True)],
    )
