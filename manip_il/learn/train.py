"""Behaviour cloning of any policy, LeRobot's or ours, with its optimiser, schedule, processors and checkpoints.

The data are in memory, so that a batch is one gather per column; a batch depends only on seed and step.
"""

from __future__ import annotations

import contextlib
import copy
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from accelerate.utils import DistributedDataParallelKwargs
from lerobot.common.train_utils import get_step_checkpoint_dir, load_training_state, save_checkpoint
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.scripts.lerobot_train import update_policy
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from lerobot.utils.random_utils import set_seed

from manip_il.data.dataset import Dataset
from manip_il.data.joined import JoinedDatasets
from manip_il.errors import NotFiniteError
from manip_il.learn.action_spaces import conversion_for
from manip_il.learn.action_steps import is_in_processors
from manip_il.learn.batches import Augment, Order, generator_of, pictures_to_float
from manip_il.learn.checkpoint import Checkpoint, Origin, in_one_line
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import lerobot_options, set_features
from manip_il.learn.lerobot_policy import build_policy, build_processors, load_processors
from manip_il.learn.names import OWN_SPACE, PLAIN
from manip_il.learn.network import threads
from manip_il.learn.samples import I64, Batch, load_data
from manip_il.learn.sources import check_same_sources, input_columns, recorded_look, row_weights
from manip_il.learn.training_state import (
    PRETRAINED_MODEL,
    Writer,
    last_checkpoint,
    metric_writers,
    new_checkpoint,
    read_step,
    write_own_files,
)
from manip_il.mdp import F64

_METRICS = ("loss", "grad_norm", "lr", "update_s", "gpu_mem_gb")  # metrics that LeRobot's `update_policy` sets
_HALF_PRECISION = {"bfloat16": "bf16", "float16": "fp16"}


class Trainer:
    """Policy, processors, optimiser and data of one run of behaviour cloning on labelled datasets.

    shares: share of the samples from each dataset. weights: how often each frame is drawn, relative to the others,
    (N,); without either, each frame is drawn once per epoch. on_start: called when the inputs have been checked, before
    anything is written. on_frames: called with the number of newly decoded
    pictures. On one CPU the same data, config and threads give the same bits, resumed or not. If started by
    `accelerate launch` or `torchrun`, every process takes `batch_size` samples per step.

    Raises `FolderExistsError` for a folder with a checkpoint unless `resume`, `NotFiniteError` for data that are not
    finite, and `ManipError` for features that the policy refuses.
    """

    def __init__(
        self,
        datasets: Sequence[Dataset],
        config: FitConfig,
        output_dir: Path,
        *,
        shares: Sequence[float] = (),
        resume: bool = False,
        on_start: Callable[[], None] | None = None,
        on_frames: Callable[[int], None] | None = None,
        weights: F64 | None = None,
    ):
        first, spec = datasets[0], datasets[0].spec
        roots, specs = [one.root for one in datasets], [one.spec for one in datasets]
        check_same_sources(roots, specs, pictures=config.takes_images, language=config.kind not in PLAIN)
        self.config, self.output_dir = config, output_dir
        self.pipeline, space = lerobot_options(config, spec.action_meaning)
        assert self.pipeline.policy is not None
        policy = self.pipeline.policy
        columns = input_columns(config, first.root, first.info)
        if on_start is not None:
            on_start()
        self.accelerator = _accelerator(policy)
        self.accelerator.wait_for_everyone()  # the first process may be emptying the folder
        checkpoint = last_checkpoint(output_dir, resume=resume)
        begun = Checkpoint.open(checkpoint / PRETRAINED_MODEL) if checkpoint else config.initial
        conversion = conversion_for(space, spec, begun)
        self._conversion = conversion if is_in_processors(policy.type, conversion) else None
        if policy.type in OWN_SPACE:
            vars(policy).update(action_space=conversion.space, grippers=conversion.grippers)
        self.meta: Any = JoinedDatasets(datasets)
        set_features(policy, self.meta.features, columns, config.observes)
        self.data = load_data(
            policy,
            self.meta,
            eval_split=config.eval_split,
            seed=config.seed,
            encode=self._conversion.encode if self._conversion else None,
            on_frames=on_frames,
        )
        self.meta.table = self.data.table
        drawn = row_weights(datasets, shares, self.data.train) if shares else None
        drawn = drawn if weights is None else weights[self.data.train]
        shift = 0 if getattr(policy, "heatmap_weight", 0) else Augment.shift  # heat maps do not move with a crop
        self._augment = Augment(shift) if config.augments else None
        self.origin = self._origin(datasets, shares, space)
        self.pipeline.dataset = DatasetConfig(self.meta.repo_id, root=str(_portable(datasets[-1].root)))
        self.pipeline.output_dir = output_dir
        self.steps = self.pipeline.steps
        self.batch_size = self.pipeline.batch_size
        self.step = 0
        with threads(config.threads):
            self._build(policy, checkpoint)
        world = self.accelerator.num_processes
        self._order = Order(len(self.data.train), drawn, self.batch_size * world, config.seed)

    def _origin(self, datasets: Sequence[Dataset], shares: Sequence[float], space: str) -> Origin:
        first, augment = datasets[0], self._augment
        return Origin.of(
            first.spec,
            first.fingerprint,
            {"eval_split": self.config.eval_split, "augment": asdict(augment) if augment else None},
            self.config.observes,
            recorded_look(first.provenance, first.fingerprint),
            datasets=[
                {"name": one.root.resolve().name, "frames": len(one), "weight": share}
                for one, share in zip(datasets, shares or [None] * len(datasets), strict=True)
            ],
            action_space=space,
        )

    def _build(self, config: PreTrainedConfig, checkpoint: Path | None) -> None:
        set_seed(self.config.seed % 2**32)  # NumPy takes no larger seeds
        before = checkpoint / PRETRAINED_MODEL if checkpoint is not None else None
        policy = build_policy(config, self.meta, before)
        optimizer, scheduler = make_optimizer_and_scheduler(self.pipeline, policy)
        if before is None or checkpoint is None:
            self.preprocessor, self.postprocessor = build_processors(config, self.meta, self._conversion)
        else:
            with in_one_line(f"{checkpoint} cannot be resumed; start again with --overwrite=true"):
                opened, learns = Checkpoint.open(before), self._conversion is not None
                processors = load_processors(opened, config, trust=self.config.trust, learns=learns)
                self.preprocessor, self.postprocessor = processors
                self.step, optimizer, scheduler = load_training_state(checkpoint, optimizer, scheduler)
        self.policy, self.optimizer, self.scheduler = self.accelerator.prepare(policy, optimizer, scheduler)
        self.unwrapped = self.accelerator.unwrap_model(self.policy)  # without the wrapper of distributed training

    def fit(self, on_step: Callable[[dict[str, Any]], None] | None = None) -> Path:
        """Take the remaining steps, with metrics and checkpoints; return the last checkpoint's `pretrained_model`.

        on_step: called after every step, with the metrics if there are any, else with {}; an exception from it ends
        the fit (after `KeyboardInterrupt` a checkpoint is saved). Raises `NotFiniteError` if the loss is not finite.
        """
        main = self.accelerator.is_main_process
        metrics = metric_writers(self.output_dir, self.step, self.config.tensorboard, self.pipeline)
        with threads(self.config.threads), metrics if main else contextlib.nullcontext(list[Writer]()) as writers:
            for record in self.run():
                for write in writers if record else []:
                    write(record)
                saved = self.step % self.pipeline.save_freq == 0 or self.step == self.steps
                if saved:
                    self.save()
                try:
                    if on_step is not None:
                        on_step(record)
                except KeyboardInterrupt:  # raised between two steps, so nothing is lost
                    if not saved:
                        self.save()
                    raise
        self.accelerator.end_training()
        return self.output_dir / "checkpoints" / "last" / PRETRAINED_MODEL

    def run(self) -> Iterator[dict[str, Any]]:
        """Take the remaining steps; yield metrics after every `log_freq`-th and the last step, {} after the others."""
        preset = self.pipeline.optimizer
        since = self.step
        started = time.perf_counter()
        assert preset is not None
        metrics = MetricsTracker(1, 1, 1, {name: AverageMeter(name) for name in _METRICS})
        while self.step < self.steps:
            batch = self.preprocessor(self._augmented(self.batch(self.step)))
            update_policy(
                metrics,
                self.policy,
                batch,
                self.optimizer,
                preset.grad_clip_norm,
                self.accelerator,
                self.scheduler,
            )
            loss, lr = metrics.metrics["loss"].val, metrics.metrics["lr"].val
            if not math.isfinite(loss):
                raise NotFiniteError(f"the loss is {loss} at step {self.step}; lower the learning rate ({lr:g})")
            self.step += 1
            if self.step % self.config.log_freq and self.step != self.steps:
                yield {}
                continue
            samples = (self.step - since) * self.batch_size * self.accelerator.num_processes
            rate = round(samples / max(time.perf_counter() - started, 1e-9), 1)
            means = {name: meter.avg for name, meter in metrics.metrics.items()}
            yield {"step": self.step, **means, "lr": lr, "samples_per_s": rate} | self.validate()
            metrics.reset_averages()
            since, started = self.step, time.perf_counter()

    def batch(self, step: int) -> Batch:
        """Return this process's samples at a step, as stored."""
        size, place = self.batch_size, self.accelerator.process_index
        rows = self._order.batch(step)[place * size : (place + 1) * size]
        return self.data.batch(self.data.train[rows])

    def validate(self) -> dict[str, float]:
        """Return the mean loss on samples of held-out episodes, without changing the random state of training.

        Also returns the other numbers that the policy outputs, such as the parts of its loss.
        """
        held_out, size = self.data.held_out, self.batch_size
        policy = self.unwrapped
        policy.eval()
        sums = defaultdict[str, float](float)
        with torch.no_grad(), torch.random.fork_rng(), self.accelerator.autocast():
            torch.manual_seed(self.config.seed)  # policies that sample (diffusion) draw the same every time
            for start in range(0, len(held_out), size):
                rows: I64 = held_out[start : start + size]
                batch = pictures_to_float(self.data.batch(rows), self.data.pictures)
                loss, outputs = policy.forward(self.preprocessor(batch))
                numbers = {name: value for name, value in (outputs or {}).items() if isinstance(value, int | float)}
                for name, value in (numbers | {"loss": loss.item()}).items():
                    sums[f"val_{name}"] += value * len(rows) / len(held_out)
        return dict(sums)

    def save(self) -> None:
        """Write a checkpoint of this step and make it the last one."""
        if self.accelerator.is_main_process:
            pipeline = copy.copy(self.pipeline)
            pipeline.output_dir = _portable(self.output_dir)
            with new_checkpoint(get_step_checkpoint_dir(self.output_dir, self.steps, self.step)) as new:
                state, processors = (self.optimizer, self.scheduler), (self.preprocessor, self.postprocessor)
                save_checkpoint(new, self.step, pipeline, self.unwrapped, *state, *processors)
                write_own_files(new, self.origin, read_step(new) | {"batch_size": self.batch_size})
        self.accelerator.wait_for_everyone()

    def _augmented(self, batch: Batch) -> Batch:
        """Move pictures to the device, shifted and recoloured by draws that depend only on seed, step and process."""
        cameras, augment = self.data.pictures, self._augment
        batch = batch | {key: batch[key].to(self.accelerator.device, non_blocking=True) for key in cameras}
        if augment is None:
            return pictures_to_float(batch, cameras)
        generator = generator_of(self.config.seed, self.step, self.accelerator.process_index)
        return batch | {camera: augment(batch[camera], generator) for camera in cameras}


def _portable(path: Path) -> Path:
    """Return a path without machine-specific parts: relative to the current folder, or else only the folder's name."""
    if not path.is_absolute():
        return path
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else Path(path.name)


def _on_this_cpu() -> str:
    """Return the precision to train in: "bf16" if the CPU supports it, else "no" (single precision)."""
    return "bf16" if torch.ops.mkldnn._is_mkldnn_bf16_supported() else "no"  # pyright: ignore[reportPrivateUsage]


def _accelerator(policy: PreTrainedConfig) -> Accelerator:
    """Return an accelerator as in lerobot-train. The policy's `dtype`, if any, or else `use_amp` sets the precision."""
    precision = _HALF_PRECISION.get(getattr(policy, "dtype", None) or "", "no")
    if not hasattr(policy, "dtype") and policy.use_amp:
        precision = _on_this_cpu() if policy.device == "cpu" else "fp16"
    if not torch.distributed.is_initialized():  # accelerate keeps the precision of the first fit in a process
        AcceleratorState._reset_state(reset_partial_state=True)  # pyright: ignore[reportPrivateUsage]
    ours = policy.type in OWN_SPACE  # every process has equal buffers, except for the cnn's mean error
    return Accelerator(
        step_scheduler_with_optimizer=False,
        mixed_precision=precision,
        cpu=policy.device == "cpu",
        kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=not ours, broadcast_buffers=not ours)],
    )
