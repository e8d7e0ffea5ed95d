"""`manip-il train`: behaviour cloning on datasets, with our policies and LeRobot's."""

from __future__ import annotations

import contextlib
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli.common_options import DatasetRoots, Trusting, own_files, start_policy
from manip_il.cli.options import Given, given, group
from manip_il.cli.outputs import ResumableOutput
from manip_il.cli.progress import Stages, progress, say, say_next, set_quiet
from manip_il.errors import UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.names import PLAIN
from manip_il.option import Seeded, option
from manip_il.seeding import stream_base

if TYPE_CHECKING:
    from manip_il.data.dataset import Dataset

RANK = "RANK"  # environment variable with the process's index in distributed training


@dataclass(frozen=True)
class SourceGroup(DatasetRoots):
    """`--dataset.*`: the training data and its weights."""

    weights: list[float] = option(list, "share of the samples from each dataset; by default its share of frames")

    def __post_init__(self) -> None:
        wrong = not all(0 < weight < math.inf for weight in self.weights)
        if self.weights and (wrong or len(self.weights) != len(self.root)):
            found = f"{self.weights} for {len(self.root)} datasets"
            raise UsageError(f"--dataset.weights is {found}; expected a number above 0 for each")


@dataclass(frozen=True)
class TrainOptions(Seeded, Trusting):
    """Fit a policy to the labels of one or more datasets of one robot (behaviour cloning).

    --policy.type is mlp, cnn or any LeRobot policy (act, diffusion, vqbet, ...); its options have LeRobot's names:
    manip-il train --policy.type=act --help lists them. OUTPUT_DIR/checkpoints/last/pretrained_model is a LeRobot
    checkpoint.
    """

    example: ClassVar[str] = (
        "manip-il train --dataset.root=datasets/demos --policy.type=act --observation=state --output_dir=runs/act"
    )
    first: ClassVar[str] = "dataset.root policy observation action_space steps batch_size output_dir resume"
    dataset: SourceGroup
    weights: Path | None = option(
        None, "rabc.parquet from manip-il data score: sampling weights of frames, as in LeRobot's RA-BC", exists=""
    )
    fit: Given = given(FitConfig, prefix="")
    output: ResumableOutput = group(ResumableOutput(Path("runs/train")), prefix="")

    def run(self) -> None:
        """Read the datasets, fit, and print the checkpoint's path."""
        from manip_il.cli.inputs import open_datasets
        from manip_il.learn.lerobot_config import lerobot_options
        from manip_il.learn.samples import rabc_weights
        from manip_il.learn.sources import input_columns
        from manip_il.learn.train import Trainer

        writes = os.environ.get(RANK, "0") == "0"  # only the first of several processes writes
        if not writes:
            set_quiet(True)
        config = self.config()
        folder = self.output.output_dir
        weights = None
        language = config.kind not in PLAIN
        datasets = open_datasets(self.dataset.root, pictures=config.takes_images, language=language)
        options, _ = lerobot_options(config)  # raises what LeRobot would, before anything is written
        for one in datasets:
            input_columns(config, one.root, one.info)  # raises if the dataset lacks an input
        if self.weights is not None:
            first = datasets[0]
            episodes = first.columns(["episode_index"])["episode_index"].astype("int64")
            ahead = getattr(options.policy, "chunk_size", None) or round(first.fps)
            weights = rabc_weights(self.weights, episodes, ahead)
        with self.output.open(self) if writes else contextlib.nullcontext():
            pictures = sum(len(one) * len(one.cameras) for one in datasets) if config.takes_images else 0
            with progress(pictures, "decode pictures, once") as bar:
                trainer = Trainer(
                    datasets,
                    config,
                    folder,
                    shares=self.dataset.weights,
                    weights=weights,
                    resume=self.output.resume,
                    on_frames=bar.step,
                )
            with Stages(f"every finished checkpoint in {folder} (one every {options.save_freq:,} steps)") as stages:
                stages.start(f"train {config.kind} on {len(trainer.data.train):,} samples", config.total_steps)
                path = trainer.fit(stages.log)
        if writes:
            say(f"checkpoint: {path}")
            self._say_next(path, datasets[0])

    def _say_next(self, path: Path, first: Dataset) -> None:
        """Print how to evaluate the policy: in simulation if an environment fits it, else on its own robot."""
        from manip_il.cli.inputs import why_not_simulated
        from manip_il.learn.checkpoint import Checkpoint

        spec, policy = first.spec, f"--policy.path={path}"
        if first.own is None and (reason := why_not_simulated(Checkpoint.open(path))):
            say(f"no simulator of this program fits the policy: {reason}")
            words = "--policy.discover_packages_path=manip_il.lerobot_plugin", f"--fps={spec.fps}", "--robot.type=TYPE"
            say_next("--strategy.type=base", policy, *words, what="next, on its robot", program="lerobot-rollout")
        else:
            say_next(
                "eval",
                policy,
                *own_files(spec.robot, spec.task, spec.object),
                f"--output_dir={self.output.output_dir}/eval",
            )

    def config(self) -> FitConfig:
        """Return the trainer's configuration; `UsageError` if options contradict each other."""
        if self.weights is not None and len(self.dataset.root) > 1:
            raise UsageError("--weights is for the frames of one dataset; give one --dataset.root")
        policy, seed = start_policy(self.fit.get("policy", {})), stream_base("training", self.seed)
        return FitConfig(**dict(self.fit, policy=policy, seed=seed, trust=self.trust))
