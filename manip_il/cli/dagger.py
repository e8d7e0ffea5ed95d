"""`manip-il dagger`: roll out, label, aggregate, refit, and repeat."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from manip_il.algorithms.config import Method, RunConfig
from manip_il.cli.common_options import SMALL, DatasetRoots, EngineOptions, Trusting, Varied
from manip_il.cli.options import Given, given
from manip_il.cli.outputs import ResumableOutput, output_folder
from manip_il.learn.fit_config import FitConfig
from manip_il.option import option
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import EnvConfig

_OF_FIT = ("policy", "action_space", "observation", "steps", "batch_size", "lr", "optimizer", "scheduler")


@dataclass(frozen=True)
class DaggerOptions(Varied, Trusting, EngineOptions, ResumableOutput):
    """Roll out the policy, query the expert in every visited state, aggregate, refit, and repeat.

    Round 0 is behaviour cloning on new demonstrations of the expert, or on those in --dataset.root. With --policy.path
    round 0 is that policy, and only the demonstrations in --dataset.root are used. --policy.type is mlp, cnn or any
    LeRobot policy, with the options of `manip-il train`. OUTPUT_DIR/best holds the round with the highest validation
    success.

    Example: manip-il dagger --rounds=5 --episodes_per_round=50 --output_dir=runs/dagger
    """

    first: ClassVar[str] = "robot.type task.type demonstrations rounds episodes_per_round policy output_dir resume"
    env: Given = given(EnvConfig)
    method: Method = option(
        "dagger",
        "who drives after round 0: the learner (dagger), the expert (cloning), or the expert with noise like the "
        "learner's errors (dart)",
    )
    dataset: DatasetRoots = field(default_factory=lambda: DatasetRoots([]))
    settings: Given = given(RunConfig, prefix="")
    query: str | None = option(
        None,
        "steps in which the expert is queried: every, one (per episode), probability:P, ensemble:BOUND, safety:BOUND; "
        "by default every; for --label=takeover: one; for --label=branch: probability:1/BRANCH_STEPS",
    )
    fit: Given = given(FitConfig, prefix="", only=_OF_FIT, fixed=("steps",))
    image: Given = given(CameraConfig, **SMALL)
    output_dir: Path = output_folder("runs/dagger")
