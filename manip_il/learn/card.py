"""The model card beside a checkpoint: what the policy is for, what it learnt from, how to run it."""

from __future__ import annotations

import string
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from huggingface_hub import ModelCard, ModelCardData
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

from manip_il.learn.checkpoint import Origin, observation_of
from manip_il.learn.transitions import Demonstrations

CARD_FILE = "README.md"


@dataclass(frozen=True)
class Story:
    """How a policy was made, for its card. text: a sentence; datasets: `repo_id`, if any; rows: name, value."""

    text: str
    datasets: str | None
    rows: tuple[tuple[str, str], ...]


def fit_story(pipeline: TrainPipelineConfig, dataset: Any, metrics: Mapping[str, Any]) -> Story:
    """Return how a policy was cloned.

    dataset: LeRobot's metadata of what was learnt from; metrics: the last record of the fit, may be empty.
    """
    optimizer = pipeline.optimizer
    rows = [
        ("learnt from", f"{dataset.total_episodes:,} episodes, {dataset.total_frames:,} frames of `{dataset.repo_id}`"),
        ("fit", f"{pipeline.steps:,} steps of {pipeline.batch_size} samples, seed {pipeline.seed}"),
        ("optimiser", f"{optimizer.type if optimizer else 'none'}, lr {optimizer.lr if optimizer else 0:g}"),
        *((name, f"{metrics[name]:.5g}") for name in ("loss", "val_loss") if name in metrics),
    ]
    return Story("Cloned from demonstrations, by manip_il.", dataset.repo_id, tuple(rows))


def learnt_by_reinforcement(demonstrations: Demonstrations | None, steps: int, seed: int, *, clone: bool) -> Story:
    """Return how a policy became what it is after so many simulated steps. clone: whether it began as one."""
    rows = [
        ("began as", "a clone" if clone else "a new network"),
        ("reinforcement learning", f"PPO, {steps:,} simulated control steps, seed {seed}"),
    ]
    if demonstrations is not None:
        frames = sum(map(len, demonstrations.inputs))
        rows.insert(1, ("demonstrations", f"{len(demonstrations.inputs):,} episodes, {frames:,} frames"))
    return Story("Learnt by reinforcement learning in MuJoCo.", None, tuple(rows))


def write_card(folder: Path, policy: PreTrainedConfig, origin: Origin, story: Story) -> None:
    """Write `README.md`, valid for the Hub, into a `pretrained_model` folder."""
    data = ModelCardData(
        license=policy.license or "apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=sorted({*(policy.tags or []), "robotics", "lerobot", "manip_il", policy.type, origin.robot, origin.task}),
        model_name=f"{policy.type}_{origin.robot}_{origin.task}",
        datasets=story.datasets,
    )
    inputs = policy.input_features or {}
    names = ", ".join(f"`{key}`" for key in inputs)
    rows = [
        ("policy", f"`{policy.type}`, sees `{observation_of(inputs)}`: {names}"),
        ("robot, task", f"`{origin.robot}`, `{origin.task}`, {origin.fps} actions/s"),
        ("action", f"{origin.action_meaning}: {', '.join(origin.joint_names)}"),
        ("learnt as", f"`{origin.action_space}`"),
        *story.rows,
        ("made by", f"manip_il {version('manip_il')}"),
    ]
    table = "\n".join(f"| {name} | {value} |" for name, value in rows)
    gymnasium_id = string.capwords(f"{origin.robot}_{origin.task}", "_").replace("_", "") + "-v0"  # PandaPickPlace-v0
    text = (
        f"---\n{data.to_yaml()}\n---\n\n"
        f"# {policy.type} for {origin.robot} {origin.task}\n\n"
        f"{story.text}\n\n"
        f"| | |\n|---|---|\n{table}\n\n"
        "Success on unseen seeds, with its interval:\n\n"
        "```sh\nmanip-il eval --policy.path=FOLDER_OF_THIS_FILE --eval.n_episodes=500 --output_dir=eval\n```\n\n"
        "The same with LeRobot:\n\n"
        "```sh\nlerobot-eval --policy.path=FOLDER_OF_THIS_FILE \\\n"
        "  --env.discover_packages_path=manip_il.lerobot_plugin \\\n"
        f"  --env.type=manip_il --env.task={gymnasium_id} --eval.n_episodes=50\n```\n"
    )
    ModelCard(text).save(folder / CARD_FILE)
