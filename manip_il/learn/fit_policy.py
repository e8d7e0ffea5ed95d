"""Behaviour cloning with any policy of LeRobot's: its optimiser, its processors, its checkpoints, our data paths.

The mlp has a loop of its own, in `manip_il.learn.train`, which says why.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs
from lerobot.common.train_utils import get_step_checkpoint_dir, load_training_state, save_checkpoint
from lerobot.configs import PreTrainedConfig
from lerobot.utils.random_utils import set_seed
from numpy.typing import NDArray

from manip_il.data.dataset import joined_columns
from manip_il.data.lerobot_library import Metadata, learn_actions, read_metadata
from manip_il.data.schema import ACTION, STATE, RobotTaskSpec
from manip_il.errors import NotFiniteError, UsageError
from manip_il.learn.action_spaces import Conversion, conversion_for, same_width
from manip_il.learn.action_steps import is_in_processors
from manip_il.learn.batches import generator_of, order_of, pictures_to_float, prefetched
from manip_il.learn.card import fit_origin, write_card
from manip_il.learn.checkpoint import (
    PRETRAINED_MODEL,
    CheckpointMeta,
    check_same_run,
    last_checkpoint,
    read_step,
    readable_state,
    unpublished,
    write_own_files,
)
from manip_il.learn.fit_config import OWN_SPACE, FitConfig
from manip_il.learn.lerobot_config import LeRobotFit, set_features
from manip_il.learn.lerobot_policy import build_policy, build_processors
from manip_il.learn.limits import threads
from manip_il.learn.metrics import Writer, metric_writers
from manip_il.learn.processes import forget_earlier_fits, sharing_batches
from manip_il.learn.samples import Batch, load_samples
from manip_il.learn.sources import Sources

F64, I64 = NDArray[np.float64], NDArray[np.int64]
_HALF_PRECISION = {"bfloat16": "bf16", "float16": "fp16"}


class PolicyTrainer:
    """Policy, processors, optimiser and data of one run that clones the labels of the dataset in `root`, or of several.

    spec, fingerprint, look: see `CheckpointMeta.of`. weights: how often each frame is drawn, relative to the others,
    (N,); by default each once an epoch, or as `sources`, the datasets of `root`, have it. on_frames: sees how many
    frames more have been decoded. On one CPU the same data, config and threads give the same bits,
    resumed or not. Started by `accelerate launch` or `torchrun`, every process takes `batch_size` samples a step; of
    `config.processes`, each takes its share of them (`fit_policy`).

    Raises `FolderExistsError` for a folder with a checkpoint unless `resume`, `MismatchError` for a run that is resumed
    on other data or options, `NotFiniteError` for data that is not finite, and what the policy refuses as `ManipError`.
    """

    def __init__(
        self,
        root: Path | Sequence[Path],
        config: FitConfig,
        output_dir: Path,
        *,
        spec: RobotTaskSpec,
        fingerprint: Mapping[str, Any] | None = None,
        look: Mapping[str, Any] | None = None,
        resume: bool = False,
        on_frames: Callable[[int], None] | None = None,
        weights: F64 | None = None,
        sources: Sources | None = None,
    ):
        self.config, self.output_dir, self.lerobot = config, output_dir, LeRobotFit(config, spec.action_meaning)
        options, observation = self.lerobot.resume_options(), self.lerobot.observation
        datasets = sources.to_json() if sources is not None else ()
        conversion = conversion_for(self.lerobot.action_space, spec)
        self.meta = CheckpointMeta.of(spec, fingerprint, options, observation, look, datasets, conversion.space)
        self.conversion = conversion if is_in_processors(self.lerobot.policy.type, conversion) else None
        self.accelerator = _accelerator(self.lerobot.policy)
        self.accelerator.wait_for_everyone()  # the first process may have had a folder to empty
        checkpoint = last_checkpoint(output_dir, resume=resume)
        roots = [root] if isinstance(root, Path) else list(root)
        self.dataset = read_metadata(*roots)
        set_features(self.lerobot.policy, self.dataset, observation)
        if self.conversion is not None:
            _convert(self.dataset, self.conversion)
        self.options = self.lerobot.resume_options()  # with the features
        self.samples = load_samples(roots, self.lerobot.policy, config, self.dataset, on_frames)
        drawn = weights[self.samples.train] if weights is not None else None
        if sources is not None and weights is None:
            drawn = weights = sources.row_weights(self.samples.train)
        self.digest = self.samples.digest
        if weights is not None:
            self.digest = hashlib.sha256(self.digest.encode() + weights.tobytes()).hexdigest()
        if checkpoint is not None:
            check_same_run(checkpoint, self.digest, self.options)
        self.pipeline = self.lerobot.pipeline(self.dataset.repo_id, str(roots[-1]), output_dir)
        self.steps, self.batch_size = config.total_steps, config.samples_per_step // config.processes
        self.step = 0
        with threads(config.threads):
            self._build(checkpoint)
        world = self.accelerator.num_processes
        self._order = order_of(len(self.samples.train), drawn, self.batch_size * world, config.seed)

    def _build(self, checkpoint: Path | None) -> None:
        config = self.lerobot.policy
        set_seed(self.config.seed)
        before = checkpoint / PRETRAINED_MODEL if checkpoint is not None else None
        if before is not None:
            config.pretrained_path = before
        policy = build_policy(config, self.dataset)
        trust, conversion = self.config.trust, self.conversion
        self.preprocessor, self.postprocessor = build_processors(
            config, self.dataset, before, trust=trust, conversion=conversion
        )
        optimizer = self.lerobot.optimizer().build(policy.get_optim_params())
        if not isinstance(optimizer, torch.optim.Optimizer):
            raise UsageError(f"--policy.type={config.type} needs several optimisers; train it with lerobot-train")
        schedule = self.lerobot.scheduler()
        scheduler = schedule.build(optimizer, self.steps) if schedule is not None else None
        if checkpoint is not None:
            read_step(checkpoint)
            with readable_state(checkpoint):
                self.step, optimizer, scheduler = load_training_state(checkpoint, optimizer, scheduler)
        self.policy, self.optimizer, self.scheduler = self.accelerator.prepare(policy, optimizer, scheduler)

    def fit(self, on_step: Callable[[dict[str, Any]], None] | None = None) -> Path:
        """Take the steps that are left, with metrics and checkpoints; return the last one's `pretrained_model`.

        on_step: called after every step, with the metrics where there are some, else with {}; an exception from it ends
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
                    self.save(record)
                try:
                    if on_step is not None:
                        on_step(record)
                except KeyboardInterrupt:  # by the user, between two steps: nothing is lost
                    if not saved:
                        self.save(record)
                    raise
        self.accelerator.end_training()
        return self.output_dir / "checkpoints" / "last" / PRETRAINED_MODEL

    def run(self) -> Iterator[dict[str, Any]]:
        """Take the steps that are left; yield the metrics at every `log_freq` and the last, else {}."""
        samples_per_step = self.batch_size * self.accelerator.num_processes
        since, started, waited, sums = self.step, time.perf_counter(), 0.0, defaultdict[str, float](float)
        batches = self.samples.source.batches(self._rows_of(step) for step in itertools.count(self.step))
        self.policy.train()
        with prefetched(itertools.islice(batches, self.steps - self.step)) as ready:
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

    def validate(self) -> dict[str, float]:
        """Return mean loss on samples of the held-out episodes, without touching the training's random state.

        Every process takes its share of them.
        """
        held_out, size = self.samples.held_out, self.config.samples_per_step
        if len(held_out) == 0:
            return {}
        policy = self.accelerator.unwrap_model(self.policy)
        policy.eval()
        total = 0.0
        with torch.no_grad(), torch.random.fork_rng(), self.accelerator.autocast():
            torch.manual_seed(self.config.seed)  # a policy that draws (diffusion) draws the same every time
            pieces = [held_out[start : start + size] for start in range(0, len(held_out), size)]
            pieces = pieces[self.accelerator.process_index :: self.accelerator.num_processes]
            for rows, batch in zip(pieces, self.samples.source.batches(pieces), strict=True):
                loss, _ = policy.forward(self.preprocessor(pictures_to_float(batch, self.samples.cameras)))
                total += loss.item() * len(rows)
        policy.train()
        if self.accelerator.num_processes > 1:
            mine = torch.tensor(total, dtype=torch.float64, device=self.accelerator.device)
            total = cast(torch.Tensor, self.accelerator.reduce(mine)).item()
        return {"val_loss": total / len(held_out)}

    def save(self, record: Mapping[str, Any]) -> None:
        """Write a checkpoint of this step and make it the last one. record: metrics for the model card."""
        if self.accelerator.is_main_process:
            policy = self.accelerator.unwrap_model(self.policy)
            own = {"data": self.digest, "options": self.options, "batch_size": self.batch_size}
            with unpublished(get_step_checkpoint_dir(self.output_dir, self.steps, self.step)) as new:
                state, processors = (self.optimizer, self.scheduler), (self.preprocessor, self.postprocessor)
                save_checkpoint(new, self.step, self.pipeline, policy, *state, *processors)
                write_own_files(new, self.meta, read_step(new) | own)
                origin = fit_origin(self.pipeline, self.dataset, record)
                write_card(new / PRETRAINED_MODEL, policy.config, self.meta, origin)
        self.accelerator.wait_for_everyone()

    def _update(self, batch: Batch) -> dict[str, float]:
        batch = self.preprocessor(self._augmented(batch))
        with self.accelerator.autocast():
            loss, outputs = self.policy.forward(batch)
        value = loss.item()
        if not math.isfinite(value):
            raise NotFiniteError(f"the loss is {value} at step {self.step}; lower the learning rate ({self._lr():g})")
        self.accelerator.backward(loss)
        clip = self.lerobot.optimizer().grad_clip_norm
        norm = self.accelerator.clip_grad_norm_(self.policy.parameters(), clip if clip > 0 else math.inf)
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
        """Put pictures on the device, shifted and recoloured by draws that depend on seed, step and process alone."""
        cameras = self.samples.cameras
        if not cameras:
            return batch
        device = self.accelerator.device
        batch = batch | {key: batch[key].to(device, non_blocking=True) for key in cameras}
        augment = self.lerobot.augment
        if augment is None or batch[cameras[0]].dtype != torch.uint8:
            return pictures_to_float(batch, cameras)
        generator = generator_of(self.config.seed, self.step, self.accelerator.process_index)
        return batch | {camera: augment(batch[camera], generator) for camera in cameras}

    def _rows_of(self, step: int) -> I64:
        """The samples of this process at a step."""
        size, place = self.batch_size, self.accelerator.process_index
        rows = self._order.batch(step).numpy()[place * size : (place + 1) * size]
        return self.samples.train[rows]

    def _lr(self) -> float:
        return float(self.optimizer.param_groups[0]["lr"])


@contextlib.contextmanager
def begin_fit(
    root: Path | Sequence[Path], config: FitConfig, output_dir: Path, **settings: Any
) -> Iterator[PolicyTrainer]:
    """Give a `PolicyTrainer` of these arguments, with the other processes of `config`, if any, at work inside."""
    silent = {name: value for name, value in settings.items() if name != "on_frames"}
    others = partial(_fit, root, config, output_dir, silent)
    with sharing_batches(config.processes, config.threads, others):
        yield PolicyTrainer(root, config, output_dir, **settings)


def _fit(root: Path | Sequence[Path], config: FitConfig, output_dir: Path, settings: dict[str, Any]) -> None:
    PolicyTrainer(root, config, output_dir, **settings).fit()


def _convert(dataset: Metadata, conversion: Conversion) -> None:
    """Leave the actions to learn with a dataset's metadata, and their statistics in place of the column's."""
    table = joined_columns(dataset.roots, [STATE, ACTION])
    same_width(table[ACTION], table[STATE], conversion.space)
    learn_actions(dataset, conversion.encode(np.asarray(table[ACTION], np.float32), table[STATE]))


def _on_this_cpu() -> str:
    """Half precision where the processor has it, else single."""
    return "bf16" if torch.ops.mkldnn._is_mkldnn_bf16_supported() else "no"  # pyright: ignore[reportPrivateUsage]


def _accelerator(policy: PreTrainedConfig) -> Accelerator:
    """As lerobot-train makes it: half precision by the policy's `dtype`, else by its `use_amp`."""
    precision = _HALF_PRECISION.get(getattr(policy, "dtype", None) or "", "no")
    if not hasattr(policy, "dtype") and policy.use_amp:
        precision = _on_this_cpu() if policy.device == "cpu" else "fp16"
    forget_earlier_fits()
    ours = policy.type in OWN_SPACE  # their buffers are units of the data, which do not change
    return Accelerator(
        step_scheduler_with_optimizer=False,
        mixed_precision=precision,
        cpu=policy.device == "cpu",
        kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=not ours, broadcast_buffers=not ours)],
    )
