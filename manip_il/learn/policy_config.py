"""What one fit of a LeRobot policy is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig, WandBConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.optim import LRSchedulerConfig, OptimizerConfig

from manip_il.errors import UsageError
from manip_il.learn.augment import Augment


@dataclass
class PolicyFitConfig:
    """How to fit any policy of LeRobot's; numbers are LeRobot's defaults where it has the option.

    observation: `state`, `images` or `both`, what the policy sees. optimizer, scheduler: the policy's own presets by
    default; lr replaces the optimiser's. eval_split: share of the episodes held out. augment: of pictures, None for
    none. image_cache_gb: how large the cache of decoded frames may grow; a dataset that does not fit goes through
    LeRobot's loader with num_workers processes.
    """

    policy: PreTrainedConfig
    steps: int = 100_000
    batch_size: int = 8
    seed: int = 0
    observation: str = "state"
    eval_split: float = 0.05
    lr: float | None = None
    optimizer: OptimizerConfig | None = None
    scheduler: LRSchedulerConfig | None = None
    augment: Augment | None = field(default_factory=Augment)
    image_cache_gb: float = 20.0
    num_workers: int = 4
    threads: int = 1
    log_freq: int = 200
    save_freq: int = 20_000
    tensorboard: bool = False
    wandb: WandBConfig = field(default_factory=WandBConfig)
    trust: bool = False

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "threads", "log_freq", "save_freq"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name} is {getattr(self, name)}; expected at least 1")
        if self.num_workers < 0 or self.image_cache_gb < 0:
            raise UsageError(
                f"num_workers is {self.num_workers}, image_cache_gb {self.image_cache_gb}; expected at least 0"
            )
        if not 0.0 <= self.eval_split < 1.0:
            raise UsageError(f"dataset.eval_split is {self.eval_split}; expected 0 <= eval_split < 1")
        if self.lr is not None and not self.lr > 0.0:
            raise UsageError(f"lr is {self.lr}; expected more than 0")

    def resolved_optimizer(self) -> OptimizerConfig:
        """Return the optimiser asked for, else the policy's preset, with `lr` in it."""
        optimizer = self.optimizer or self.policy.get_optimizer_preset()
        if self.lr is not None:
            optimizer.lr = self.lr
        return optimizer

    def resolved_scheduler(self) -> LRSchedulerConfig | None:
        """Return the schedule asked for, else the policy's preset; None is a constant rate."""
        return self.scheduler or self.policy.get_scheduler_preset()

    def lerobot(self, repo_id: str, root: str, output_dir: Any) -> TrainPipelineConfig:
        """Return the same as LeRobot's `train_config.json`, from which `lerobot-train --resume=true` goes on."""
        return TrainPipelineConfig(
            dataset=DatasetConfig(repo_id, root=root),
            policy=self.policy,
            output_dir=output_dir,
            job_name=f"manip_il_{self.policy.type}",
            seed=self.seed,
            num_workers=self.num_workers,
            batch_size=self.batch_size,
            steps=self.steps,
            env_eval_freq=0,
            log_freq=self.log_freq,
            save_freq=self.save_freq,
            optimizer=self.resolved_optimizer(),
            scheduler=self.resolved_scheduler(),
            wandb=self.wandb,
        )

    def what_changes_the_weights(self) -> dict[str, Any]:
        """Return the options that a resumed fit must share with the one before, as JSON knows them."""
        return {
            "policy": _without_machine(draccus.encode(self.policy)),
            "optimizer": draccus.encode(self.resolved_optimizer()),
            "scheduler": draccus.encode(self.resolved_scheduler()) if self.resolved_scheduler() else None,
            "augment": draccus.encode(self.augment) if self.augment else None,
            **{
                name: getattr(self, name) for name in ("steps", "batch_size", "seed", "observation", "eval_split", "lr")
            },
        }


def _without_machine(policy: dict[str, Any]) -> dict[str, Any]:
    """A policy's options without those that say where it runs and where its weights came from."""
    return {name: value for name, value in policy.items() if name not in ("device", "pretrained_path")}
