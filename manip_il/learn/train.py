"""Training in memory: the whole table is a tensor, a batch is one `index_select`.

A loop of its own beside `fit_policy`'s: with LeRobot's processors, prefetching and accelerator around each step the mlp
takes a quarter fewer samples a second (32,000 for 42,000 in batches of 512, one busy core), and initialisation, order
of updates and schedule are others, so that runs begun here would not resume to the same bits.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.default import DatasetConfig, WandBConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.optim import AdamWConfig
from numpy.typing import NDArray
from safetensors.torch import load_file

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE, RobotTaskSpec
from manip_il.errors import FolderExistsError, NotFiniteError, UsageError
from manip_il.learn.checkpoint import (
    PRETRAINED_MODEL,
    CheckpointMeta,
    check_same_run,
    last_checkpoint,
    load_optimizer,
    read_step,
    readable_state,
    save_checkpoint,
)
from manip_il.learn.columns import Rows, Table, check_table, learning_rows, split_by_episode, valid_frames
from manip_il.learn.metrics import metric_writers
from manip_il.learn.mlp.configuration_mlp import MLPConfig
from manip_il.learn.mlp.modeling_mlp import MLPPolicy
from manip_il.learn.normalise import fit_statistics
from manip_il.learn.order import order_of
from manip_il.learn.threads import threads
from manip_il.learn.warm_start import warm_start

# Do not change the weights that come out at the end (threads: only in the last bits).
_FREE_ON_RESUME = ("threads", "log_freq", "save_freq", "init_from")
_TOLD_ELSEWHERE = ("tensorboard", "wandb")  # options of nobody but this run's user


@dataclass
class TrainConfig:
    """How to fit. `lr` is the peak: linear warm-up over `warmup_steps`, then a cosine down to zero.

    val_fraction: share of the episodes held out for the metrics, 0 for none. init_from: a
    `pretrained_model` folder whose weights to start from. save_freq, log_freq: in steps. threads:
    a second one is up to 1.8 times as fast where a core is free, and tens of times slower where
    none is.
    """

    steps: int = 3_000
    batch_size: int = 512
    lr: float = 2e-3
    warmup_steps: int = 100
    weight_decay: float = 1e-4
    grad_clip_norm: float = 10.0
    val_fraction: float = 0.05
    seed: int = 0
    threads: int = 1
    log_freq: int = 200
    save_freq: int = 1_000
    init_from: Path | None = None
    tensorboard: bool = False
    wandb: WandBConfig = field(default_factory=WandBConfig)
    policy: MLPConfig = field(default_factory=MLPConfig)

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "threads", "log_freq", "save_freq"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name} is {getattr(self, name)}; expected at least 1")
        if not 0.0 <= self.val_fraction < 1.0:
            raise UsageError(f"val_fraction is {self.val_fraction}; expected 0 <= val_fraction < 1")
        if not self.lr > 0.0:
            raise UsageError(f"lr is {self.lr}; expected more than 0")

    def lerobot(self, repo_id: str, output_dir: Path) -> TrainPipelineConfig:
        """Return the same in LeRobot's words, for its logger."""
        optimizer = AdamWConfig(lr=self.lr, weight_decay=self.weight_decay, grad_clip_norm=self.grad_clip_norm)
        return TrainPipelineConfig(
            dataset=DatasetConfig(repo_id),
            policy=self.policy,
            output_dir=output_dir,
            job_name="manip_il_mlp",
            seed=self.seed,
            batch_size=self.batch_size,
            steps=self.steps,
            env_eval_freq=0,
            log_freq=self.log_freq,
            save_freq=self.save_freq,
            optimizer=optimizer,
            wandb=self.wandb,
        )

    def lr_at(self, step: int) -> float:
        """Return learning rate of the update with number `step`, from 0."""
        warmup = min(self.warmup_steps, self.steps // 10)
        if step < warmup:
            return self.lr * (step + 1) / (warmup + 1)
        return self.lr * 0.5 * (1.0 + math.cos(math.pi * (step - warmup) / max(1, self.steps - warmup)))


def fit(
    table: Table,
    config: TrainConfig,
    output_dir: Path,
    *,
    spec: RobotTaskSpec,
    fingerprint: Mapping[str, Any] | None = None,
    on_log: Callable[[dict[str, Any]], None] | None = None,
    resume: bool = False,
    weights: NDArray[np.float64] | None = None,
    repo_id: str = "local/table",
) -> Path:
    """Clone the labels of `table` and return `output_dir/checkpoints/last/pretrained_model`.

    table: the schema's `observation.state`, `observation.environment_state`, `action` and, where
    there, `label_valid`, `episode_index`, `frame_index`. weights: how often each frame is drawn, relative
    to the others, (N,); by default each once an epoch. repo_id: what Weights & Biases calls the data. The
    same table, config and number of threads give the same bits, resumed or not. Metrics go to `on_log`,
    `metrics.jsonl`, and where the config says.

    Raises `FolderExistsError` for a folder with a checkpoint unless `resume`, `NotFiniteError` for
    data or a loss that is not finite, `MismatchError` for a table that does not fit `spec` or a
    run that is resumed on other data or options.
    """
    output_dir = Path(output_dir)
    checkpoint = last_checkpoint(output_dir)
    if checkpoint is not None and not resume:
        raise FolderExistsError(output_dir)
    check_table(table, spec)
    rows = learning_rows(table)
    drawn = weights[valid_frames(table)] if weights is not None else None
    options = {name: value for name, value in draccus.encode(config).items() if name not in _TOLD_ELSEWHERE}
    meta = CheckpointMeta.of(spec, fingerprint, options)
    digest = _digest(rows, drawn)
    key = {"data": digest, "options": {k: v for k, v in options.items() if k not in _FREE_ON_RESUME}}
    with threads(config.threads):
        if checkpoint is not None:
            check_same_run(checkpoint, digest, json.loads(json.dumps(key["options"])))
        trainer = Trainer(rows, config, spec, checkpoint, drawn)
        pipeline = config.lerobot(repo_id, output_dir)
        with metric_writers(output_dir, trainer.step, config.tensorboard, pipeline) as writers:
            for record in trainer.run():
                for write in writers if record else []:
                    write(record)
                if record and on_log is not None:
                    on_log(record)
                if trainer.step % config.save_freq == 0 or trainer.step == config.steps:
                    save_checkpoint(output_dir, trainer.step, trainer.policy, meta, trainer.optimizer, key)
    return output_dir / "checkpoints" / "last" / PRETRAINED_MODEL


class Trainer:
    """Policy, optimiser and encoded data of one run; `run()` yields once a step."""

    def __init__(
        self,
        rows: Rows,
        config: TrainConfig,
        spec: RobotTaskSpec,
        checkpoint: Path | None = None,
        weights: NDArray[np.float64] | None = None,
    ) -> None:
        self.config = config
        self.step = 0
        train, held_out = split_by_episode(rows.episodes, config.val_fraction, config.seed)
        self.policy = _new_policy(config, spec)
        self.policy.model.set_statistics(fit_statistics(rows.inputs[train], rows.targets[train], config.policy.loss))
        self.policy.to(self.policy.config.device)
        self.optimizer = torch.optim.AdamW(
            self.policy.parameters(), lr=config.lr, weight_decay=config.weight_decay, fused=True
        )
        if checkpoint is not None:
            self._restore(checkpoint)
        elif config.init_from is not None:
            warm_start(self.policy.model, config.init_from)
        self._encode(rows, train, held_out)
        drawn = weights[train] if weights is not None else None
        self.order = order_of(len(train), drawn, config.batch_size, config.seed)

    def _restore(self, checkpoint: Path) -> None:
        with readable_state(checkpoint):
            self.policy.load_state_dict(load_file(checkpoint / PRETRAINED_MODEL / "model.safetensors"))
        load_optimizer(checkpoint, self.optimizer)
        self.step = read_step(checkpoint)["step"]

    def _encode(self, rows: Rows, train: NDArray[np.int64], held_out: NDArray[np.int64]) -> None:
        device = self.policy.config.device
        inputs, targets = torch.from_numpy(rows.inputs).to(device), torch.from_numpy(rows.targets).to(device)
        # One tensor [x | y], so that a batch is one gather of whole rows.
        encoded = torch.cat([self.policy.model.encode(inputs), self.policy.model.encode_targets(targets)], dim=1)
        self.width = inputs.shape[1]
        self.data, self.held_out = encoded[train], encoded[held_out]
        self.held_out_inputs, self.held_out_targets = inputs[held_out], targets[held_out]

    def run(self) -> Iterator[dict[str, Any]]:
        """Take the steps that are left; yield the metrics at every `log_freq` and the last, else {}."""
        self.policy.train()
        since, started, total = self.step, time.perf_counter(), 0.0
        while self.step < self.config.steps:
            total += self._update()
            self.step += 1
            if self.step % self.config.log_freq and self.step != self.config.steps:
                yield {}
                continue
            steps, seconds = self.step - since, time.perf_counter() - started
            record = {"step": self.step, "loss": total / steps, "lr": self.optimizer.param_groups[0]["lr"]}
            record["samples_per_s"] = round(steps * self.config.batch_size / max(seconds, 1e-9))
            yield record | self.validate()
            since, started, total = self.step, time.perf_counter(), 0.0

    def batch(self, step: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Encoded inputs (B, n + k) and targets (B, n) of one step."""
        rows = self.data.index_select(0, self.order.batch(step).to(self.data.device))
        return rows[:, : self.width], rows[:, self.width :]

    def validate(self) -> dict[str, float]:
        """Return loss on the held-out episodes, and the mean absolute errors of acting: arm [rad], gripper [m]."""
        if len(self.held_out) == 0:
            return {}
        network = self.policy.model
        with torch.no_grad():
            loss = network.row_losses(self.held_out[:, : self.width], self.held_out[:, self.width :]).mean()
            state = self.held_out_inputs[:, : network.n]
            relative = network.act(self.held_out_inputs) - torch.nn.functional.pad(state[:, :-1], (0, 1))
            error = (relative - self.held_out_targets).abs().mean(0)
        return {
            "val_loss": loss.item(),
            "val_arm_error": error[:-1].mean().item(),
            "val_gripper_error": error[-1].item(),
        }

    def _update(self) -> float:
        x, y = self.batch(self.step)
        loss = self.policy.model.row_losses(x, y).mean()
        value = loss.item()
        if not math.isfinite(value):
            raise NotFiniteError(f"the loss is {value} at step {self.step}; lower lr (now {self.config.lr})")
        self.optimizer.param_groups[0]["lr"] = self.config.lr_at(self.step)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.config.grad_clip_norm)
        self.optimizer.step()
        return value


def _new_policy(config: TrainConfig, spec: RobotTaskSpec) -> MLPPolicy:
    n, k = len(spec.joint_names), len(spec.environment_state_names)
    policy_config = copy.deepcopy(config.policy)
    policy_config.input_features = {STATE: PolicyFeature(type=FeatureType.STATE, shape=(n,))}
    if k:
        policy_config.input_features[ENVIRONMENT_STATE] = PolicyFeature(type=FeatureType.ENV, shape=(k,))
    policy_config.output_features = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(n,))}
    # torch initialises layers from its global generator: lend it one of our own.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return MLPPolicy(policy_config)


def _digest(rows: Rows, weights: NDArray[np.float64] | None) -> str:
    digest = hashlib.sha256()
    for column in (rows.inputs, rows.targets, rows.episodes, *([weights] if weights is not None else [])):
        digest.update(np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()
