"""How a policy is to be fitted, as a user says it: the mlp by its own loop, every other one by LeRobot's means."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manip_il.checks import read_json
from manip_il.errors import UsageError
from manip_il.learn.policy_names import check_names
from manip_il.option import option

if TYPE_CHECKING:  # torch and LeRobot take seconds to import
    from manip_il.learn.policy_config import PolicyFitConfig
    from manip_il.learn.train import TrainConfig

MLP = "mlp"  # the one policy with a loop of its own
MLP_STEPS, MLP_BATCH_SIZE, MLP_LR, MLP_SAVE_FREQ = 3_000, 512, 2e-3, 1_000
STEPS, BATCH_SIZE, SAVE_FREQ = 100_000, 8, 20_000  # LeRobot's defaults
_AT_LEAST_1 = ("steps", "batch_size", "threads", "log_freq", "save_freq")
_AT_LEAST_0 = ("num_workers", "image_cache_gb")


@dataclass(frozen=True)
class FitConfig:
    """Options by LeRobot's names; None is the default of the policy's kind.

    policy: `type` or `path`, and what that policy knows (`loss`, `width`, `chunk_size`, ...). optimizer, scheduler:
    in place of the policy's own. trust: whether models that the policy or its checkpoint names may be loaded.

    Raises `UsageError` for a number out of range, `UnknownName` for a policy or an option of it that is not there.
    """

    policy: Mapping[str, Any] = option(dict, "type (mlp), or path of a policy to start from; ...")
    observation: str | None = option(
        None, "what the policy observes besides its joints; by default images if it is cnn, else state"
    )
    steps: int | None = option(None, f"gradient steps; by default {MLP_STEPS:,} for mlp, else {STEPS:,}")
    batch_size: int | None = option(
        None, f"frames per step (and process); by default {MLP_BATCH_SIZE} for mlp, else {BATCH_SIZE}"
    )
    lr: float | None = option(None, f"peak learning rate; by default {MLP_LR} for mlp, else the policy's own")
    optimizer: Mapping[str, Any] = option(dict, "in place of the policy's own: type (adamw), ...")
    scheduler: Mapping[str, Any] = option(dict, "in place of the policy's own: type, ...")
    eval_split: float = option(0.05, "share of the episodes held out for val_loss")
    image_augment: bool = option(True, "random crops and colour jitter of pictures while training")
    image_cache_gb: float = option(20.0, "disk limit of decoded pictures [GB]; beyond it LeRobot's loader is used")
    num_workers: int = option(4, "processes of LeRobot's loader")
    threads: int = option(1, "PyTorch threads; more help only on free cores")
    save_freq: int | None = option(
        None, f"steps between checkpoints; by default {MLP_SAVE_FREQ:,} for mlp, else {SAVE_FREQ:,}"
    )
    log_freq: int = option(200, "steps between metrics")
    tensorboard: bool = option(False, "curves for TensorBoard, in OUTPUT_DIR/tensorboard")
    wandb: Mapping[str, Any] = option(dict, "Weights & Biases: enable, project, mode, ...")
    trust: bool = False

    def __post_init__(self) -> None:
        for name, least in (*((name, 1) for name in _AT_LEAST_1), *((name, 0) for name in _AT_LEAST_0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise UsageError(f"{name} is {value}; expected at least {least}")
        if not 0.0 <= self.eval_split < 1.0:
            raise UsageError(f"dataset.eval_split is {self.eval_split}; expected at least 0 and less than 1")
        if self.lr is not None and not 0.0 < self.lr < math.inf:
            raise UsageError(f"lr is {self.lr}; expected more than 0")
        check_names(self.policy, MLP)
        if self.is_mlp and self.observation not in (None, "state"):
            raise UsageError(
                f"--policy.type=mlp does not take images, so not --observation={self.observation}; use cnn"
            )

    @property
    def is_mlp(self) -> bool:
        """Whether the policy is fitted by `manip_il.learn.train`."""
        return "path" not in self.policy and self.policy.get("type", MLP) == MLP

    @property
    def sees(self) -> bool:
        """Whether the policy looks at pictures; `ManipError` where that is for the checkpoint in `path` to say."""
        if self.is_mlp or self.observation is not None:
            return not self.is_mlp and self.observation != "state"
        path = self.policy.get("path")
        kind = read_json(Path(path) / "config.json", "a policy's").get("type") if path else self.policy["type"]
        return kind == "cnn"

    @property
    def total_steps(self) -> int:
        """Gradient steps."""
        return self.steps if self.steps is not None else MLP_STEPS if self.is_mlp else STEPS

    @property
    def plan_length(self) -> int:
        """Actions that the policy plans at once: 1 for one that maps a state to an action."""
        indices = None if self.is_mlp else self.other(0).policy.action_delta_indices
        return len(indices) if indices else 1

    @property
    def dropped_frames(self) -> int:
        """Frames at an episode's end that the policy does not learn from."""
        return 0 if self.is_mlp else getattr(self.other(0).policy, "drop_n_last_frames", 0)

    def mlp(self, seed: int, init_from: Path | None = None) -> TrainConfig:
        """For `manip_il.learn.train.fit`. Raises `UsageError` for what the mlp does not know."""
        for name in ("optimizer", "scheduler"):
            if getattr(self, name):
                raise UsageError(f"--{name} is not for --policy.type=mlp, which has its own loop and schedule")
        from lerobot.configs.default import WandBConfig

        from manip_il.learn.choices import plain, policy_config
        from manip_il.learn.mlp.configuration_mlp import MLPConfig
        from manip_il.learn.train import TrainConfig

        policy = policy_config(self.policy, MLP)
        assert isinstance(policy, MLPConfig)
        return TrainConfig(
            steps=self.total_steps,
            batch_size=MLP_BATCH_SIZE if self.batch_size is None else self.batch_size,
            lr=MLP_LR if self.lr is None else self.lr,
            val_fraction=self.eval_split,
            seed=seed,
            threads=self.threads,
            save_freq=MLP_SAVE_FREQ if self.save_freq is None else self.save_freq,
            log_freq=self.log_freq,
            init_from=init_from,
            tensorboard=self.tensorboard,
            wandb=plain(WandBConfig, self.wandb, "wandb"),
            policy=policy,
        )

    def other(self, seed: int, init_from: Path | None = None) -> PolicyFitConfig:
        """For `manip_il.learn.fit_policy`. init_from: weights to start from. Raises what `policy_config` raises."""
        from lerobot.configs.default import WandBConfig
        from lerobot.optim import LRSchedulerConfig, OptimizerConfig

        from manip_il.learn.augment import Augment
        from manip_il.learn.choices import choice, plain, policy_config
        from manip_il.learn.policy_config import PolicyFitConfig

        policy = policy_config(self.policy, trust=self.trust)
        if init_from is not None:
            policy.pretrained_path = init_from
        return PolicyFitConfig(
            policy=policy,
            steps=self.total_steps,
            batch_size=BATCH_SIZE if self.batch_size is None else self.batch_size,
            seed=seed,
            observation=self.observation or ("images" if policy.type == "cnn" else "state"),
            eval_split=self.eval_split,
            lr=self.lr,
            optimizer=choice(OptimizerConfig, self.optimizer, "optimizer") if self.optimizer else None,
            scheduler=choice(LRSchedulerConfig, self.scheduler, "scheduler") if self.scheduler else None,
            augment=Augment() if self.image_augment else None,
            image_cache_gb=self.image_cache_gb,
            num_workers=self.num_workers,
            threads=self.threads,
            log_freq=self.log_freq,
            save_freq=SAVE_FREQ if self.save_freq is None else self.save_freq,
            tensorboard=self.tensorboard,
            wandb=plain(WandBConfig, self.wandb, "wandb"),
            trust=self.trust,
        )
