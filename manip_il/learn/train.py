"""Behaviour cloning of any policy, LeRobot's or ours, with its optimiser, schedule, processors and
checkpoints.

The data are in memory, so that a batch is one gather per column; a batch depends only on seed and
step.

Train a policy on datasets: behaviour cloning.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from itertools import repeat
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

from manip_il.data.atomic import output_of, require_ours
from manip_il.data.dataset import Dataset, JoinedDatasets
from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.errors import NotFiniteError, UsageError, warn
from manip_il.learn.action_spaces import conversion_for
from manip_il.learn.action_steps import is_in_processors
from manip_il.learn.batches import Augment, Order, generator_of, to_float
from manip_il.learn.checkpoint import Checkpoint, Origin, in_one_line
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import lerobot_options, policy_config, set_features
from manip_il.learn.lerobot_policy import build_policy, build_processors, load_processors
from manip_il.learn.names import OWN_SPACE, PLAIN
from manip_il.learn.network import threads
from manip_il.learn.paraphrases import rephrased
from manip_il.learn.samples import (
    TASK,
    Batch,
    Samples,
    check_same_sources,
    check_shares,
    input_columns,
    load_data,
    rabc_weights,
    recorded_look,
    row_weights,
)
from manip_il.learn.training_state import (
    PRETRAINED_MODEL,
    last_checkpoint,
    metric_writers,
    new_checkpoint,
)
from manip_il.mdp import F64, I64
from manip_il.option import make_options
from manip_il.progress import Progress
from manip_il.seeding import stream_base

# metrics that LeRobot's `update_policy` sets
_METRICS = ("loss", "grad_norm", "lr", "update_s", "gpu_mem_gb")
_HALF_PRECISION = {"bfloat16": "bf16", "float16": "fp16"}


class Trainer:
    """One run of behaviour cloning on labelled datasets: its data, its networks, and the steps that
    fit them.

    On one CPU the same data, config and threads give the same bits, resumed or not. If started by
    `accelerate launch` or `torchrun`, every process takes `batch_size` samples per step.

    Args:
        datasets: The labelled datasets.
        config: The options of the fit.
        output_dir: The folder of the run.
        shares: Share of the samples from each dataset.
        weights: How often each frame is drawn, relative to the others, (N,). Without weights and
            shares, each frame is drawn once per epoch.
        resume: Continue from the folder's last checkpoint.
        on_start: Called when the inputs have been checked, before anything is written.
        on_frames: Called with the number of newly decoded pictures.

    Raises:
        FolderExistsError: The folder has a checkpoint, and `resume` is not set.
        NotFiniteError: The data are not finite.
        ManipError: The policy refuses the features of the data.
    """

    def __init__(
        self,
        datasets: Sequence[Dataset],
        config: FitConfig,
        output_dir: Path,
        *,
        shares: Sequence[float] = (),
        resume: bool = False,
        on_start: Callable[[], None] = lambda: None,
        on_frames: Callable[[int], None] | None = None,
        weights: F64 | None = None,
    ):
        self.config = config
        self.output_dir = output_dir
        self.datasets = datasets
        specs = {dataset.root: dataset.spec for dataset in datasets}
        language = config.kind not in PLAIN or config.kind in OWN_SPACE
        check_same_sources(specs, pictures=config.takes_images, language=language)
        check_shares(shares, datasets)
        spec = datasets[0].spec
        self.pipeline: Any  # LeRobot's options
        self.pipeline, space = lerobot_options(config, spec.action_meaning)
        columns = input_columns(config, datasets[0].root, datasets[0].info)
        on_start()
        self.accelerator = _accelerator(self.pipeline.policy)
        self.accelerator.wait_for_everyone()  # the first process may be emptying the folder
        last = last_checkpoint(output_dir, resume=resume)
        resumed = None if last is None else Checkpoint.open(last / PRETRAINED_MODEL)
        self.conversion = conversion_for(space, spec, resumed or config.initial)
        in_processors = is_in_processors(self.pipeline.policy.type, self.conversion)
        self.encoder = self.conversion if in_processors else None  # else the network converts
        self.meta: Any = JoinedDatasets(datasets)
        if not language and len(self.meta.tasks) > 1:
            warn(f"{config.kind} reads no text, and the data have {len(self.meta.tasks)} tasks")
        self.data = self.read_data(columns, on_frames)
        self.order = self.draw_order(shares, weights)
        self._augment = Augment() if config.augments else None
        self.origin = self.describe(shares)
        self.step = 0
        with threads(config.threads):
            self.build_networks(resumed)

    def read_data(self, columns: Sequence[str], on_frames: Callable[[int], None] | None) -> Samples:
        """Read the samples of the datasets.

        Args:
            columns: The columns that the policy observes.
            on_frames: Called with the number of newly decoded pictures.
        """
        policy, config = self.pipeline.policy, self.config
        if policy.type in OWN_SPACE:
            policy.action_space = self.conversion.space
            policy.grippers = self.conversion.grippers
        set_features(policy, self.meta.features, columns, config.observes)
        self.pipeline.dataset = DatasetConfig(
            self.meta.repo_id, root=str(_portable(self.datasets[-1].root))
        )
        return load_data(
            policy,
            self.meta,
            eval_split=config.eval_split,
            seed=config.seed,
            conversion=self.encoder,
            on_frames=on_frames,
        )

    def draw_order(self, shares: Sequence[float], weights: F64 | None) -> Order:
        """Return the order in which all processes together draw the training samples.

        Args:
            shares: Share of the samples from each dataset; empty for none.
            weights: How often each frame is drawn, relative to the others, (N,). They replace the
                shares.
        """
        rows = self.data.train
        drawn = row_weights(self.datasets, shares, rows) if shares else None
        drawn = drawn if weights is None else weights[rows]
        batch_size = self.pipeline.batch_size * self.accelerator.num_processes
        return Order(len(rows), drawn, batch_size, self.config.seed)

    def describe(self, shares: Sequence[float]) -> Origin:
        """Return what a checkpoint stores about its training."""
        first = self.datasets[0]
        augment = asdict(self._augment) if self._augment else None
        return Origin.of(
            first.spec,
            first.fingerprint,
            {"eval_split": self.config.eval_split, "augment": augment},
            observation=self.config.observes,
            look=recorded_look(first.provenance, first.fingerprint),
            datasets=[
                {"name": dataset.root.resolve().name, "frames": len(dataset), "weight": share}
                for dataset, share in zip(self.datasets, shares or repeat(None), strict=False)
            ],
            action_space=self.conversion.space,
        )

    def build_networks(self, resumed: Checkpoint | None) -> None:
        """Build policy, processors, optimiser and schedule, or load them from the checkpoint to
        resume.
        """
        set_seed(self.config.seed % 2**32)  # NumPy takes no larger seeds
        config = self.pipeline.policy
        policy = build_policy(config, self.meta, resumed)
        optimizer, scheduler = make_optimizer_and_scheduler(self.pipeline, policy)
        if resumed is None:
            processors = build_processors(config, self.meta, self.encoder)
        else:
            last = resumed.path.parent
            with in_one_line(f"{last} cannot be resumed; start again with --overwrite=true"):
                learns = self.encoder is not None
                processors = load_processors(
                    resumed, config, trust=self.config.trust, learns=learns
                )
                self.step, optimizer, scheduler = load_training_state(last, optimizer, scheduler)
        self.preprocessor, self.postprocessor = processors
        self.policy, self.optimizer, self.scheduler = self.accelerator.prepare(
            policy, optimizer, scheduler
        )
        # without the wrapper of distributed training
        self.unwrapped = self.accelerator.unwrap_model(self.policy)

    def fit(self, on_step: Callable[[dict[str, Any]], None] | None = None) -> Path:
        """Take the remaining steps, with metrics and checkpoints.

        Args:
            on_step: Called after every step, with the metrics if there are any, else with {}. An
                exception from it ends the fit; after `KeyboardInterrupt` a checkpoint is saved.

        Returns:
            The last checkpoint's `pretrained_model` folder.

        Raises:
            NotFiniteError: The loss is not finite.
        """
        writers = []
        if self.accelerator.is_main_process:
            curves = self.config.tensorboard
            writers = metric_writers(self.output_dir, self.step, curves, self.pipeline)
        with threads(self.config.threads):
            for record in self.run():
                for write in writers if record else []:
                    write(record)
                saved = self.step % self.pipeline.save_freq == 0 or self.step == self.pipeline.steps
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
        """Take the remaining steps.

        Yield metrics after every `log_freq`-th and the last step, {} after the others.
        """
        metrics = MetricsTracker(1, 1, 1, {name: AverageMeter(name) for name in _METRICS})
        since, started = self.step, time.perf_counter()
        while self.step < self.pipeline.steps:
            self.take_step(metrics)
            if self.step % self.config.log_freq and self.step != self.pipeline.steps:
                yield {}
                continue
            samples = (self.step - since) * self.order.batch_size
            rate = round(samples / max(time.perf_counter() - started, 1e-9), 1)
            means = {name: meter.avg for name, meter in metrics.metrics.items()}
            lr = metrics.metrics["lr"].val
            yield {"step": self.step, **means, "lr": lr, "samples_per_s": rate} | self.validate()
            metrics.reset_averages()
            since, started = self.step, time.perf_counter()

    def take_step(self, metrics: MetricsTracker) -> None:
        """Take one gradient step, which `metrics` counts.

        Raises:
            NotFiniteError: The loss is not finite.
        """
        update_policy(
            metrics,
            self.policy,
            self._prepared(self.batch(self.step), self._augment),
            self.optimizer,
            self.pipeline.optimizer.grad_clip_norm,
            self.accelerator,
            self.scheduler,
        )
        loss, lr = metrics.metrics["loss"].val, metrics.metrics["lr"].val
        if not math.isfinite(loss):
            raise NotFiniteError(
                f"the loss is {loss} at step {self.step}; lower the learning rate ({lr:g})"
            )
        self.step += 1

    def batch(self, step: int) -> Batch:
        """Return this process's samples at a step, as stored."""
        size, place = self.pipeline.batch_size, self.accelerator.process_index
        rows = self.order.batch(step)[place * size : (place + 1) * size]
        batch = self.data.batch(self.data.train[rows])
        if getattr(self.pipeline.policy, "reads_text", False):
            batch[TASK] = rephrased(batch[TASK], [self.config.seed, step, place])
        return batch

    def validate(self) -> dict[str, float]:
        """Return the mean loss on samples of held-out episodes, if there are any, without changing
        the random state of training.
        """
        held_out, size = self.data.held_out, self.pipeline.batch_size
        policy = self.unwrapped
        policy.eval()
        total = 0.0
        with torch.no_grad(), torch.random.fork_rng(), self.accelerator.autocast():
            # policies that sample (diffusion) draw the same every time
            torch.manual_seed(self.config.seed)
            for start in range(0, len(held_out), size):
                rows: I64 = held_out[start : start + size]
                loss, _ = policy.forward(self._prepared(self.data.batch(rows)))
                total += loss.item() * len(rows)
        return {"val_loss": total / len(held_out)} if len(held_out) else {}

    def save(self) -> None:
        """Write a checkpoint of this step and make it the last one."""
        if self.accelerator.is_main_process:
            steps = self.pipeline.steps
            self.pipeline.output_dir = _portable(self.output_dir)
            with new_checkpoint(get_step_checkpoint_dir(self.output_dir, steps, self.step)) as new:
                save_checkpoint(
                    new,
                    self.step,
                    self.pipeline,
                    self.unwrapped,
                    self.optimizer,
                    self.scheduler,
                    self.preprocessor,
                    self.postprocessor,
                    batch_size=self.pipeline.batch_size,
                )
                self.origin.write(new / PRETRAINED_MODEL)
        self.accelerator.wait_for_everyone()

    def _prepared(self, batch: Batch, augment: Augment | None = None) -> Batch:
        """Return what the policy reads of a batch.

        With `augment`, its pictures are shifted and recoloured by draws that depend only on seed,
        step and process.
        """
        convert = to_float
        if augment is not None:
            key = self.config.seed, self.step, self.accelerator.process_index
            convert = partial(augment, generator=generator_of(*key))
        device = self.accelerator.device
        pictures = {
            camera: convert(batch[camera].to(device, non_blocking=True))
            for camera in self.data.pictures
        }
        return self.preprocessor(batch | pictures)


def _portable(path: Path) -> Path:
    """Return a path without machine-specific parts: relative to the current folder, or else only
    the folder's name.
    """
    if not path.is_absolute():
        return path
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else Path(path.name)


def _accelerator(policy: PreTrainedConfig) -> Accelerator:
    """Return an accelerator as in lerobot-train.

    The policy's `dtype`, if any, or else `use_amp` sets the precision.
    """
    precision = _HALF_PRECISION.get(getattr(policy, "dtype", None) or "", "no")
    if not hasattr(policy, "dtype") and policy.use_amp:
        precision = "fp16"
        if policy.device == "cpu":
            mkldnn: Any = torch.ops.mkldnn
            precision = "bf16" if mkldnn._is_mkldnn_bf16_supported() else "no"
    # accelerate keeps the precision of the first fit in a process
    if not torch.distributed.is_initialized():
        state: Any = AcceleratorState
        state._reset_state(reset_partial_state=True)
    return Accelerator(
        step_scheduler_with_optimizer=False,
        mixed_precision=precision,
        cpu=policy.device == "cpu",
        kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=True)],
    )


Data = Dataset | Path | str


def train(
    datasets: Data | Sequence[Data],
    output_dir: Path | str,
    *,
    seed: int = 0,
    shares: Sequence[float] = (),
    weights: Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Checkpoint:
    """Fit a policy to the labels of one or more datasets.

    Args:
        datasets: The datasets, or their folders.
        output_dir: The folder for checkpoints and metrics.
        seed: 0 to 1000.
        shares: Share of the samples from each dataset; by default its share of the frames.
        weights: `rabc.parquet` of the only dataset, by which its frames are drawn.
        resume: Whether to continue the fit in the folder.
        progress: Follows the fit.
        options: Fields of `FitConfig`, such as `policy={"type": "mlp", "width": 128}` and `steps`.

    Returns:
        The last checkpoint.

    Raises:
        UsageError: for an option that is unknown or invalid, or a folder with other files.
        ManipError: for data that do not fit the policy.
    """
    progress = progress or Progress()
    given = (datasets,) if isinstance(datasets, Data) else datasets
    if not given:
        raise UsageError("no dataset was given to train on")
    folder = Path(output_dir).expanduser()
    require_ours(folder, output_of("Train"))
    opened = [
        one if isinstance(one, Dataset) else Dataset.open(Path(one).expanduser()) for one in given
    ]
    config = make_options(FitConfig, seed=stream_base("training", seed), **options)
    if weights is not None and (shares or len(opened) > 1):
        raise UsageError("weights are for the frames of one dataset; give it alone, without shares")
    drawn = None
    if weights is not None:
        ahead = getattr(policy_config(config), "chunk_size", None) or round(opened[0].fps)
        episodes = opened[0].columns([EPISODE_INDEX])[EPISODE_INDEX].astype("int64")
        drawn = rabc_weights(weights, episodes, ahead)
    pictures = sum(len(one) * len(one.cameras) for one in opened) if config.takes_images else 0
    progress.start("decode pictures, once", pictures)
    trainer = Trainer(
        opened,
        config,
        folder,
        shares=shares,
        weights=drawn,
        resume=resume,
        on_start=progress.started,
        on_frames=progress.step,
    )
    progress.start(
        f"train {config.kind} on {len(trainer.data.train):,} samples", config.total_steps
    )
    return Checkpoint.open(trainer.fit(progress.log))
