"""Training of the mlp: the whole table is a tensor, in memory or mapped into it, a batch is one `index_select`.

A loop of its own beside `fit_policy`'s: with LeRobot's processors, prefetching and accelerator around each step the mlp
takes a quarter fewer samples a second (32,000 for 42,000 in batches of 512, one busy core), and initialisation, order
of updates and schedule are others, so that runs begun here would not resume to the same bits.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state
from lerobot.policies.factory import make_pre_post_processors
from numpy.typing import NDArray
from safetensors.torch import load_file

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE, RobotTaskSpec
from manip_il.errors import NotFiniteError
from manip_il.learn.action_spaces import ARM, GRIPPER, JOINT_DELTAS, Conversion, conversion_for
from manip_il.learn.action_steps import add_steps, is_in_processors
from manip_il.learn.batches import order_of
from manip_il.learn.checkpoint import (
    PRETRAINED_MODEL,
    TRAINING_STATE,
    CheckpointMeta,
    check_same_run,
    last_checkpoint,
    read_step,
    readable_state,
    unpublished,
    write_own_files,
)
from manip_il.learn.columns import Rows, Table, check_table, learning_rows, split_by_episode, valid_frames
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import LeRobotFit
from manip_il.learn.limits import threads
from manip_il.learn.metrics import metric_writers
from manip_il.learn.mlp.configuration_mlp import MLPConfig
from manip_il.learn.mlp.modeling_mlp import MLPPolicy
from manip_il.learn.network import fit_statistics, warm_start
from manip_il.learn.sources import Sources

WARMUP_STEPS, WEIGHT_DECAY, GRAD_CLIP_NORM = 100, 1e-4, 10.0
# Do not change the weights that come out at the end (threads: only in the last bits).
_FREE_ON_RESUME = ("threads", "log_freq", "save_freq", "init_from")


def fit(
    table: Table,
    config: FitConfig,
    output_dir: Path,
    *,
    spec: RobotTaskSpec,
    fingerprint: Mapping[str, Any] | None = None,
    on_log: Callable[[dict[str, Any]], None] | None = None,
    resume: bool = False,
    weights: NDArray[np.float64] | None = None,
    sources: Sources | None = None,
    repo_id: str = "local/table",
) -> Path:
    """Clone the labels of `table` and return `output_dir/checkpoints/last/pretrained_model`.

    table: the schema's `observation.state`, `observation.environment_state`, `action` and, where
    there, `label_valid`, `episode_index`, `frame_index`. weights: how often each frame is drawn, relative
    to the others, (N,); by default each once an epoch, or as `sources`, the datasets of the table, have it.
    Statistics are those of all frames learnt from, each counted once. repo_id: what Weights & Biases calls the
    data. The same table, config and number of threads give the same bits, resumed or not. Metrics go
    to `on_log`, `metrics.jsonl`, and where the config says.
    Raises `FolderExistsError` for a folder with a checkpoint unless `resume`, `NotFiniteError` for data or a loss that
    is not finite, `MismatchError` for a table that does not fit `spec` or a run that is resumed on other data or
    options, and what `conversion_for` raises.
    """
    output_dir = Path(output_dir)
    checkpoint = last_checkpoint(output_dir, resume=resume)
    check_table(table, spec)
    lerobot = LeRobotFit(config, spec.action_meaning)
    conversion = conversion_for(lerobot.action_space, spec)
    rows = learning_rows(table, conversion)
    drawn = weights[valid_frames(table)] if weights is not None else _drawn(table, rows, config, sources)
    options = _options(lerobot)
    data = sources.to_json() if sources else ()
    meta = CheckpointMeta.of(spec, fingerprint, options, datasets=data, action_space=conversion.space)
    digest = _digest(rows, drawn)
    key = {"data": digest, "options": {k: v for k, v in options.items() if k not in _FREE_ON_RESUME}}
    with threads(config.threads):
        if checkpoint is not None:
            check_same_run(checkpoint, digest, json.loads(json.dumps(key["options"])))
        trainer = Trainer(rows, lerobot, spec, checkpoint, drawn, conversion)
        pipeline = lerobot.pipeline(repo_id, None, output_dir)
        with metric_writers(output_dir, trainer.step, config.tensorboard, pipeline) as writers:
            for record in trainer.run():
                for write in writers if record else []:
                    write(record)
                if record and on_log is not None:
                    on_log(record)
                if trainer.step % config.steps_per_checkpoint == 0 or trainer.step == config.total_steps:
                    trainer.save(output_dir, meta, key)
    return output_dir / "checkpoints" / "last" / PRETRAINED_MODEL


class Trainer:
    """Policy, optimiser and encoded data of one run; `run()` yields once a step."""

    def __init__(
        self,
        rows: Rows,
        lerobot: LeRobotFit,
        spec: RobotTaskSpec,
        checkpoint: Path | None = None,
        weights: NDArray[np.float64] | None = None,
        conversion: Conversion = JOINT_DELTAS,
    ) -> None:
        config, self.conversion = lerobot.config, conversion
        self.steps, self.batch_size, self.log_freq = config.total_steps, config.samples_per_step, config.log_freq
        self.peak_lr = lerobot.optimizer().lr
        self.step = 0
        train, held_out = split_by_episode(rows.episodes, config.eval_split, config.seed)
        self.policy = new_policy(lerobot, spec)
        network = self.policy.model
        network.set_statistics(fit_statistics(rows.inputs, rows.targets, network.loss, train))
        self.policy.to(self.policy.config.device)
        self.optimizer = torch.optim.AdamW(
            self.policy.parameters(), lr=self.peak_lr, weight_decay=WEIGHT_DECAY, fused=True
        )
        if checkpoint is not None:
            with readable_state(checkpoint):
                self.policy.load_state_dict(load_file(checkpoint / PRETRAINED_MODEL / "model.safetensors"))
                load_optimizer_state(self.optimizer, checkpoint / TRAINING_STATE)
            self.step = read_step(checkpoint)["step"]
        elif config.init_from is not None:
            warm_start(network, config.init_from)
        self.width = rows.inputs.shape[1]
        # One tensor [x | y], so that a batch is one gather of whole rows.
        self.data, self.held_out = (self._encoded(rows, part) for part in (train, held_out))
        device = self.policy.config.device
        self.held_out_inputs = torch.from_numpy(rows.inputs[held_out]).to(device)
        self.held_out_targets = torch.from_numpy(rows.targets[held_out]).to(device)
        drawn = weights[train] if weights is not None else None
        self.order = order_of(len(train), drawn, self.batch_size, config.seed)

    def _encoded(self, rows: Rows, wanted: NDArray[np.int64]) -> torch.Tensor:
        """Encoded inputs and targets of some rows, (S, n + k + n)."""
        network, device = self.policy.model, self.policy.config.device
        inputs, targets = (torch.from_numpy(one[wanted]).to(device) for one in (rows.inputs, rows.targets))
        return torch.cat([network.encode(inputs), network.encode_targets(targets)], dim=1)

    def run(self) -> Iterator[dict[str, Any]]:
        """Take the steps that are left; yield the metrics at every `log_freq` and the last, else {}."""
        self.policy.train()
        since, started, total = self.step, time.perf_counter(), 0.0
        while self.step < self.steps:
            total += self._update()
            self.step += 1
            if self.step % self.log_freq and self.step != self.steps:
                yield {}
                continue
            steps, seconds = self.step - since, time.perf_counter() - started
            record = {"step": self.step, "loss": total / steps, "lr": self.optimizer.param_groups[0]["lr"]}
            record["samples_per_s"] = round(steps * self.batch_size / max(seconds, 1e-9))
            yield record | self.validate()
            since, started, total = self.step, time.perf_counter(), 0.0

    def batch(self, step: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return encoded inputs (B, n + k) and targets (B, n) of one step."""
        rows = self.data.index_select(0, self.order.batch(step).to(self.data.device))
        return rows[:, : self.width], rows[:, self.width :]

    def validate(self) -> dict[str, float]:
        """Return loss on the held-out episodes, and the mean absolute errors of acting: arm [rad], gripper [m]."""
        if len(self.held_out) == 0:
            return {}
        network = self.policy.model
        with torch.no_grad():
            loss = network.row_losses(self.held_out[:, : self.width], self.held_out[:, self.width :]).mean()
            relative = network.relative(network.act(self.held_out_inputs), self.held_out_inputs)
            error = (relative - self.held_out_targets).abs().mean(0)
        return {
            "val_loss": loss.item(),
            "val_arm_error": error[ARM].mean().item(),
            "val_gripper_error": error[GRIPPER].item(),
        }

    def save(self, output_dir: Path, meta: CheckpointMeta, resume_key: Mapping[str, Any]) -> None:
        """Write a checkpoint of this step, make it the last one and remove those before.

        resume_key: what a resumed run must share with this one (JSON values).
        """
        final = output_dir / "checkpoints" / f"{self.step:06d}"
        with unpublished(final) as new:
            state = new / TRAINING_STATE
            save_policy(self.policy, self.conversion, new / PRETRAINED_MODEL)
            state.mkdir()
            save_optimizer_state(self.optimizer, state)
            write_own_files(new, meta, {"step": self.step, **resume_key})
        for other in final.parent.iterdir():
            if not other.is_symlink() and other.name != final.name:
                shutil.rmtree(other, ignore_errors=True)

    def _update(self) -> float:
        x, y = self.batch(self.step)
        loss = self.policy.model.row_losses(x, y).mean()
        value = loss.item()
        if not math.isfinite(value):
            raise NotFiniteError(f"the loss is {value} at step {self.step}; lower lr (now {self.peak_lr})")
        self.optimizer.param_groups[0]["lr"] = lr_at(self.step, self.steps, self.peak_lr)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), GRAD_CLIP_NORM)
        self.optimizer.step()
        return value


def save_policy(policy: MLPPolicy, conversion: Conversion, folder: Path) -> None:
    """Write configuration, weights and processors of an mlp to a new folder, as LeRobot has them."""
    folder.mkdir()
    policy.save_pretrained(folder)
    processors = make_pre_post_processors(policy.config)
    if is_in_processors(policy.config.type, conversion):
        add_steps(*processors, conversion)
    for processor in processors:
        processor.save_pretrained(folder)


def lr_at(step: int, steps: int, peak: float) -> float:
    """Return the learning rate of an update, from 0 to `steps` - 1: linear warm-up, then a cosine down to zero."""
    warmup = min(WARMUP_STEPS, steps // 10)
    if step < warmup:
        return peak * (step + 1) / (warmup + 1)
    return peak * 0.5 * (1.0 + math.cos(math.pi * (step - warmup) / max(1, steps - warmup)))


def _drawn(table: Table, rows: Rows, config: FitConfig, sources: Sources | None) -> NDArray[np.float64] | None:
    """Weights of the R rows, (R,), where the datasets have weights; 0 for rows that are held out."""
    if sources is None or not sources.weights:
        return None
    train, _ = split_by_episode(rows.episodes, config.eval_split, config.seed)
    drawn = np.zeros(len(rows.episodes))
    drawn[train] = sources.row_weights(np.flatnonzero(valid_frames(table))[train])
    return drawn


def new_policy(lerobot: LeRobotFit, spec: RobotTaskSpec) -> MLPPolicy:
    """Return an mlp for data of `spec`, with weights drawn from the fit's seed."""
    n, k = len(spec.joint_names), len(spec.environment_state_names)
    policy_config = copy.deepcopy(lerobot.policy)
    assert isinstance(policy_config, MLPConfig)
    policy_config.input_features = {STATE: PolicyFeature(type=FeatureType.STATE, shape=(n,))}
    if k:
        policy_config.input_features[ENVIRONMENT_STATE] = PolicyFeature(type=FeatureType.ENV, shape=(k,))
    policy_config.output_features = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(n,))}
    # torch initialises layers from its global generator: lend it one of our own.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(lerobot.config.seed)
        return MLPPolicy(policy_config)


def _options(lerobot: LeRobotFit) -> dict[str, Any]:
    """The options that a checkpoint names, as JSON knows them."""
    config = lerobot.config
    return {
        "steps": config.total_steps,
        "batch_size": config.samples_per_step,
        "lr": config.peak_lr,
        "warmup_steps": WARMUP_STEPS,
        "weight_decay": WEIGHT_DECAY,
        "grad_clip_norm": GRAD_CLIP_NORM,
        "val_fraction": config.eval_split,
        "seed": config.seed,
        "threads": config.threads,
        "log_freq": config.log_freq,
        "save_freq": config.steps_per_checkpoint,
        "init_from": str(config.init_from) if config.init_from else None,
        "policy": draccus.encode(lerobot.policy),
    }


def _digest(rows: Rows, weights: NDArray[np.float64] | None) -> str:
    digest = hashlib.sha256()
    for column in (rows.inputs, rows.targets, rows.episodes, *([weights] if weights is not None else [])):
        digest.update(np.ascontiguousarray(column))
    return digest.hexdigest()
