"""`manip-il train`: behaviour cloning on one dataset."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from manip_il.cli.folders import prepare_output
from manip_il.cli.groups import PolicyGroup, check_dataset, check_same_options, option, save_options
from manip_il.cli.progress import say

# What may differ when a fit is resumed: nothing of it changes the weights.
_FREE = ("threads", "log_freq", "save_freq", "dataset.root", "output_dir")


@dataclass
class SourceGroup:
    """`--dataset.*` of what is learnt from."""

    root: Path = field(metadata={"help": "folder of a LeRobot v3.0 dataset"})


@dataclass
class FullPolicyGroup(PolicyGroup):
    """`--policy.*` with all that one fit may choose."""

    activation: str = option("silu", "between layers")
    components: int = option(5, "of the mixture")
    bins: int = option(101, "a dimension, of categorical")


@dataclass
class TrainOptions:
    """Fit a policy to the labels of a dataset (behaviour cloning).

    The checkpoint is LeRobot's: OUTPUT_DIR/checkpoints/last/pretrained_model.
    """

    example: ClassVar[str] = "manip-il train --dataset.root=datasets/demos --output_dir=runs/cloned"
    dataset: SourceGroup
    policy: FullPolicyGroup = field(default_factory=FullPolicyGroup)
    steps: int = option(3_000, "gradient steps")
    batch_size: int = option(512, "frames a step")
    lr: float = option(2e-3, "highest learning rate")
    output_dir: Path = field(default=Path("runs/train"), metadata={"help": "folder of the run"})
    seed: int = option(0, "of weights and batches, 0 to 1000")
    threads: int = option(1, "more help only where cores are free")
    save_freq: int = option(1_000, "steps between checkpoints")
    log_freq: int = option(200, "steps between metrics")
    resume: bool = option(False, "go on from the last checkpoint")
    overwrite: bool = option(False, "replace a run that is there")

    def run(self) -> None:
        """Read the dataset, fit, and say where the checkpoint is."""
        policy = self.policy.config()
        from manip_il.dagger.loop import LEARNING_COLUMNS
        from manip_il.data.lerobot_io import read_fingerprint, read_spec, read_table
        from manip_il.learn.train import TrainConfig
        from manip_il.seeding import stream_base

        config = TrainConfig(
            steps=self.steps,
            batch_size=self.batch_size,
            lr=self.lr,
            seed=stream_base("training", self.seed),
            threads=self.threads,
            save_freq=self.save_freq,
            log_freq=self.log_freq,
            policy=policy,
        )
        spec, fingerprint = read_spec(self.dataset.root), read_fingerprint(self.dataset.root)
        table = read_table(self.dataset.root, (*LEARNING_COLUMNS, "frame_index"))
        check_dataset(self.dataset.root, spec, fingerprint)
        prepare_output(self.output_dir, resume=self.resume, overwrite=self.overwrite)
        if self.resume:
            check_same_options(self.output_dir, self, _FREE)
        save_options(self.output_dir, self)
        self._fit(table, config, spec, fingerprint)

    def _fit(self, table, config, spec, fingerprint) -> None:
        from manip_il.cli.stages import Stages
        from manip_il.learn.train import fit

        with Stages(kept=f"the last checkpoint in {self.output_dir} (one every {self.save_freq:,} steps)") as stages:
            stages.start(f"train on {len(table['action']):,} frames", self.steps)
            path = fit(
                table,
                config,
                self.output_dir,
                spec=spec,
                fingerprint=fingerprint,
                on_log=stages.log,
                resume=self.resume,
            )
        say(f"checkpoint: {path}")
        say(f"next: manip-il eval --policy.path={path} --output_dir={self.output_dir}/eval")
