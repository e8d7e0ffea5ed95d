"""Behaviour cloning with any policy of LeRobot's or ours: its optimiser and schedule, its processors, its checkpoints.

The data are in memory, so that a batch is one gather a column; a batch is a function of seed and step alone.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from accelerate.utils import DistributedDataParallelKwargs
from lerobot.common.train_utils import get_step_checkpoint_dir, load_training_state, save_checkpoint
from lerobot.configs import PreTrainedConfig
from lerobot.utils.random_utils import set_seed
from numpy.typing import NDArray

from manip_il.data.joined import JoinedDatasets
from manip_il.data.schema import RobotTaskSpec
from manip_il.errors import MismatchError, NotFiniteError, UsageError
from manip_il.learn.action_spaces import conversion_for
from manip_il.learn.action_steps import is_in_processors
from manip_il.learn.batches import Order, generator_of, pictures_to_float, prefetched
from manip_il.learn.checkpoint import Origin
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import LeRobotFit, without_places
from manip_il.learn.lerobot_policy import build_policy, build_processors
from manip_il.learn.metrics import Writer, metric_writers
from manip_il.learn.names import OWN_SPACE
from manip_il.learn.network import threads
from manip_il.learn.samples import I64, Batch, load_data
from manip_il.learn.sources import Sources, input_columns
from manip_il.learn.training_state import (
    PRETRAINED_MODEL,
    last_checkpoint,
    read_step,
    readable_state,
    unpublished,
    write_own_files,
)

_HALF_PRECISION = {"bfloat16": "bf16", "float16": "fp16"}


class Trainer:
    """Policy, processors, optimiser and data of one run that clones the labels of datasets.

    spec, fingerprint, look: see `Origin.of`; by default those of the first dataset. weights: how often each frame is
    drawn, relative to the others, (N,); by default each once an epoch, or as `sources` has it. on_frames: sees how many
    pictures more have been decoded. On one CPU the same data, config and threads give the same bits, resumed or not.
    Started by `accelerate launch` or `torchrun`, every process takes `batch_size` samples a step.

    Raises `FolderExistsError` for a folder with a checkpoint unless `resume`, `MismatchError` for a run that is resumed
    on other data, `NotFiniteError` for data that is not finite, and what the policy refuses as `ManipError`.
    """

    def __init__(
        self,
        sources: Sources,
        config: FitConfig,
        output_dir: Path,
        *,
        spec: RobotTaskSpec | None = None,
        fingerprint: Mapping[str, Any] | None = None,
        look: Mapping[str, Any] | None = None,
        resume: bool = False,
        on_frames: Callable[[int], None] | None = None,
        weights: NDArray[np.float64] | None = None,
    ):
        first, spec = sources.datasets[0], spec or sources.spec
        self.config, self.output_dir, self.lerobot = config, output_dir, LeRobotFit(config, spec.action_meaning)
        conversion = conversion_for(self.lerobot.action_space, spec)
        self.conversion = conversion if is_in_processors(self.lerobot.policy.type, conversion) else None
        self.accelerator = _accelerator(self.lerobot.policy)
        self.accelerator.wait_for_everyone()  # the first process may have had a folder to empty
        checkpoint = last_checkpoint(output_dir, resume=resume)
        self.meta: Any = JoinedDatasets(sources.roots)
        self.lerobot.set_features(self.meta.features, input_columns(config, first.root, first.info))
        self.data = load_data(
            self.lerobot.policy,
            self.meta,
            eval_split=config.eval_split,
            seed=config.seed,
            encode=self.conversion.encode if self.conversion else None,
            on_frames=on_frames,
        )
        self.meta.table = self.data.table
        drawn = weights[self.data.train] if weights is not None else sources.row_weights(self.data.train)
        self.digest = self.data.digest
        if drawn is not None:
            self.digest = hashlib.sha256(self.digest.encode() + drawn.tobytes()).hexdigest()
        if checkpoint is not None and (learnt := read_step(checkpoint).get("data")) != self.digest:
            raise MismatchError("training data", f"checkpoint {checkpoint}", learnt, "this run", self.digest)
        self.origin = Origin.of(
            spec,
            first.fingerprint if fingerprint is None else fingerprint,
            self.lerobot.to_json(),
            config.observes,
            sources.looks[0] if look is None else look,
            datasets=sources.to_json(),
            action_space=conversion.space,
        )
        self.pipeline = self.lerobot.pipeline(self.meta.repo_id, sources.roots[-1], output_dir)
        self.steps, self.batch_size, self.step = config.total_steps, config.samples_per_step, 0
        with threads(config.threads):
            self._build(checkpoint)
        world = self.accelerator.num_processes
        self._order = Order(len(self.data.train), drawn, self.batch_size * world, config.seed)

    def _build(self, checkpoint: Path | None) -> None:
        config = self.lerobot.policy
        set_seed(self.config.seed)
        before = checkpoint / PRETRAINED_MODEL if checkpoint is not None else None
        policy = build_policy(config, self.meta, before)
        self.preprocessor, self.postprocessor = build_processors(
            config, self.meta, before, trust=self.config.trust, conversion=self.conversion
        )
        preset = self.lerobot.optimizer()
        self._clip = preset.grad_clip_norm if preset.grad_clip_norm > 0 else math.inf
        optimizer = preset.build(policy.get_optim_params())
        if not isinstance(optimizer, torch.optim.Optimizer):
            raise UsageError(f"--policy.type={config.type} needs several optimisers; train it with lerobot-train")
        schedule = self.lerobot.scheduler()
        scheduler = schedule.build(optimizer, self.steps) if schedule is not None else None
        if checkpoint is not None:
            read_step(checkpoint)
            with readable_state(checkpoint):
                self.step, optimizer, scheduler = load_training_state(checkpoint, optimizer, scheduler)
        self.policy, self.optimizer, self.scheduler = self.accelerator.prepare(policy, optimizer, scheduler)
        self.unwrapped = self.accelerator.unwrap_model(self.policy)  # of the processes that share a batch

    def fit(self, on_step: Callable[[dict[str, Any]], None] | None = None) -> Path:
        """Take the steps that are left, with metrics and checkpoints; return the last one's `pretrained_model`.

        on_step: called after every step, with the metrics if there are some, else with {}; an exception from it ends
        the fit, `KeyboardInterrupt` after a checkpoint. Raises `NotFiniteError` for a loss that is not finite.
        """
        main = self.accelerator.is_main_process
        metrics = metric_writers(self.output_dir, self.step, self.config.tensorboard, self.pipeline)
        with threads(self.config.threads), metrics if main else contextlib.nullcontext(list[Writer]()) as writers:
            for record in self.run():
                for write in writers if record else []:
                    write(record)
                saved = self.step % self.config.steps_per_checkpoint == 0 or self.step == self.steps
                if saved:
                    self.save()
                try:
                    if on_step is not None:
                        on_step(record)
                except KeyboardInterrupt:  # by the user, between two steps: nothing is lost
                    if not saved:
                        self.save()
                    raise
        self.accelerator.end_training()
        return self.output_dir / "checkpoints" / "last" / PRETRAINED_MODEL

    def run(self) -> Iterator[dict[str, Any]]:
        """Take the steps that are left; yield the metrics at every `log_freq` and the last, else {}."""
        samples_per_step = self.batch_size * self.accelerator.num_processes
        since, started, waited, sums = self.step, time.perf_counter(), 0.0, defaultdict[str, float](float)
        batches = (self.batch(step) for step in range(self.step, self.steps))
        self.policy.train()
        # ahead only if there are pictures: a thread costs more than a gather of numbers
        with prefetched(batches) if self.data.cameras else contextlib.nullcontext(batches) as ready:
            while self.step < self.steps:
                asked = time.perf_counter()
                batch = next(ready)
                waited += time.perf_counter() - asked
                for name, value in self._update(batch).items():
                    sums[name] += value
                self.step += 1
                if self.step % self.config.log_freq and self.step != self.steps:
                    yield {}
                    continue
                steps, seconds = self.step - since, max(time.perf_counter() - started, 1e-9)
                record = {
                    "step": self.step,
                    **{name: total / steps for name, total in sums.items()},
                    "samples_per_s": round(steps * samples_per_step / seconds, 1),
                    "data_share": round(waited / seconds, 4),
                    "lr": self._lr(),
                }
                since, started, waited, sums = self.step, time.perf_counter(), 0.0, defaultdict[str, float](float)
                yield record | self.validate()

    def batch(self, step: int) -> Batch:
        """Return the samples of this process at a step, as they are stored."""
        size, place = self.batch_size, self.accelerator.process_index
        rows = self._order.batch(step)[place * size : (place + 1) * size]
        return self.data.samples.batch(self.data.train[rows])

    def validate(self) -> dict[str, float]:
        """Return mean loss on samples of the held-out episodes, without touching the training's random state.

        Beside `val_loss`, the numbers that the policy gives with it. Every process looks at all of them.
        """
        held_out, size = self.data.held_out, self.config.samples_per_step
        if len(held_out) == 0:
            return {}
        policy = self.unwrapped
        policy.eval()
        sums = defaultdict[str, float](float)
        with torch.no_grad(), torch.random.fork_rng(), self.accelerator.autocast():
            torch.manual_seed(self.config.seed)  # a policy that draws (diffusion) draws the same every time
            for start in range(0, len(held_out), size):
                rows: I64 = held_out[start : start + size]
                batch = pictures_to_float(self.data.samples.batch(rows), self.data.cameras)
                loss, outputs = policy.forward(self.preprocessor(batch))
                for name, value in (_numbers(outputs) | {"loss": loss.item()}).items():
                    sums[f"val_{name}"] += value * len(rows) / len(held_out)
        policy.train()
        return dict(sums)

    def save(self) -> None:
        """Write a checkpoint of this step and make it the last one."""
        if self.accelerator.is_main_process:
            own = {"data": self.digest, "batch_size": self.batch_size}
            with unpublished(get_step_checkpoint_dir(self.output_dir, self.steps, self.step)) as new:
                state, processors = (self.optimizer, self.scheduler), (self.preprocessor, self.postprocessor)
                save_checkpoint(new, self.step, without_places(self.pipeline), self.unwrapped, *state, *processors)
                write_own_files(new, self.origin, read_step(new) | own)
        self.accelerator.wait_for_everyone()

    def _update(self, batch: Batch) -> dict[str, float]:
        batch = self.preprocessor(self._augmented(batch))
        with self.accelerator.autocast():
            loss, outputs = self.policy.forward(batch)
        value = loss.item()
        if not math.isfinite(value):
            raise NotFiniteError(f"the loss is {value} at step {self.step}; lower the learning rate ({self._lr():g})")
        self.accelerator.backward(loss)
        norm = self.accelerator.clip_grad_norm_(self.policy.parameters(), self._clip)
        self.optimizer.step()
        self.optimizer.zero_grad()
        if self.scheduler is not None:
            self.scheduler.step()
        if callable(update := getattr(self.unwrapped, "update", None)):
            update()  # averages of weights and the like, as lerobot-train calls it
        return _numbers(outputs) | {"loss": value, "grad_norm": math.nan if norm is None else float(norm)}

    def _augmented(self, batch: Batch) -> Batch:
        """Put pictures on the device, shifted and recoloured by draws that depend on seed, step and process alone."""
        cameras, augment = self.data.cameras, self.lerobot.augment
        batch = batch | {key: batch[key].to(self.accelerator.device, non_blocking=True) for key in cameras}
        if augment is None:
            return pictures_to_float(batch, cameras)
        generator = generator_of(self.config.seed, self.step, self.accelerator.process_index)
        return batch | {camera: augment(batch[camera], generator) for camera in cameras}

    def _lr(self) -> float:
        return float(self.optimizer.param_groups[0]["lr"])


def fit(sources: Sources, config: FitConfig, output_dir: Path, **settings: Any) -> Path:
    """Fit a policy to datasets and return its `pretrained_model` folder; arguments and errors are `Trainer`'s."""
    return Trainer(sources, config, output_dir, **settings).fit()


def _numbers(outputs: Mapping[str, Any] | None) -> dict[str, float]:
    return {name: float(value) for name, value in (outputs or {}).items() if isinstance(value, int | float)}


def _on_this_cpu() -> str:
    """Half precision if the processor has it, else single."""
    return "bf16" if torch.ops.mkldnn._is_mkldnn_bf16_supported() else "no"  # pyright: ignore[reportPrivateUsage]


def _accelerator(policy: PreTrainedConfig) -> Accelerator:
    """As lerobot-train makes it: half precision by the policy's `dtype`, else by its `use_amp`."""
    precision = _HALF_PRECISION.get(getattr(policy, "dtype", None) or "", "no")
    if not hasattr(policy, "dtype") and policy.use_amp:
        precision = _on_this_cpu() if policy.device == "cpu" else "fp16"
    if not torch.distributed.is_initialized():  # accelerate keeps the precision of a process's first fit
        AcceleratorState._reset_state(reset_partial_state=True)  # pyright: ignore[reportPrivateUsage]
    ours = policy.type in OWN_SPACE  # their buffers are units of the data, which do not change
    return Accelerator(
        step_scheduler_with_optimizer=False,
        mixed_precision=precision,
        cpu=policy.device == "cpu",
        kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=not ours, broadcast_buffers=not ours)],
    )
