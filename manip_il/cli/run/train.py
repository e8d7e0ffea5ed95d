"""Run `manip-il train`: behaviour cloning on datasets, with our policies and LeRobot's."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from manip_il.cli.progress import Stages, progress, say, say_next, set_quiet
from manip_il.cli.run.inputs import open_datasets, own_files, start_policy, why_not_simulated
from manip_il.cli.train import RANK, TrainOptions
from manip_il.data.dataset import Dataset
from manip_il.errors import UsageError
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import lerobot_options
from manip_il.learn.names import PLAIN
from manip_il.learn.samples import rabc_weights
from manip_il.learn.sources import input_columns
from manip_il.learn.train import Trainer
from manip_il.seeding import stream_base


def run_train(options: TrainOptions) -> None:
    """Read the datasets, fit, and print the checkpoint's path."""
    writes = os.environ.get(RANK, "0") == "0"  # only the first of several processes writes
    if not writes:
        set_quiet(True)
    config = fit_config(options)
    folder = options.output.output_dir
    weights = None
    language = config.kind not in PLAIN
    datasets = open_datasets(options.dataset.root, pictures=config.takes_images, language=language)
    pipeline, _ = lerobot_options(config)  # raises what LeRobot would, before anything is written
    for one in datasets:
        input_columns(config, one.root, one.info)  # raises if the dataset lacks an input
    if options.weights is not None:
        first = datasets[0]
        episodes = first.columns(["episode_index"])["episode_index"].astype("int64")
        ahead = getattr(pipeline.policy, "chunk_size", None) or round(first.fps)
        weights = rabc_weights(options.weights, episodes, ahead)
    with options.output.open(options) if writes else contextlib.nullcontext():
        pictures = sum(len(one) * len(one.cameras) for one in datasets) if config.takes_images else 0
        with progress(pictures, "decode pictures, once") as bar:
            trainer = Trainer(
                datasets,
                config,
                folder,
                shares=options.dataset.weights,
                weights=weights,
                resume=options.output.resume,
                on_frames=bar.step,
            )
        with Stages(f"every finished checkpoint in {folder} (one every {pipeline.save_freq:,} steps)") as stages:
            stages.start(f"train {config.kind} on {len(trainer.data.train):,} samples", config.total_steps)
            path = trainer.fit(stages.log)
    if writes:
        say(f"checkpoint: {path}")
        _say_next(options, path, datasets[0])


def _say_next(options: TrainOptions, path: Path, first: Dataset) -> None:
    """Print how to evaluate the policy: in simulation if an environment fits it, else on its own robot."""
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
            f"--output_dir={options.output.output_dir}/eval",
        )


def fit_config(options: TrainOptions) -> FitConfig:
    """Return the trainer's configuration; `UsageError` if options contradict each other."""
    if options.weights is not None and len(options.dataset.root) > 1:
        raise UsageError("--weights is for the frames of one dataset; give one --dataset.root")
    policy, seed = start_policy(options.fit.get("policy", {})), stream_base("training", options.seed)
    return FitConfig(**dict(options.fit, policy=policy, seed=seed, trust=options.trust))
