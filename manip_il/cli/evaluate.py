"""`manip-il eval`: how often a policy succeeds on unseen seeds."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

from manip_il.cli.common_options import OF_POLICY, EngineOptions, Tested, Trusting
from manip_il.cli.options import Given, given
from manip_il.cli.outputs import ResumableOutput, output_folder
from manip_il.option import Seeded, option
from manip_il.worlds.config import EnvConfig


@dataclass(frozen=True)
class MeasuredPolicyGroup:
    """`--policy.*`: the policy to evaluate."""

    path: Path | None = option(None, "a checkpoint or a run")
    type: Literal["expert", "random"] | None = option(None, "who drives instead of a checkpoint")
    device: str = option("cpu", "where the policy runs: cpu or cuda")


@dataclass(frozen=True)
class EvalGroup:
    """`--eval.*`: the episodes to run."""

    n_episodes: int | None = option(
        None, "test episodes; by default 100, or up to 10,000 with --until_width", at_least=1, grows=True
    )
    first: int = option(0, "index of the first seed in the stream, to run a large evaluation in parts", at_least=0)
    hold: int | None = option(
        10, "control steps after success until an episode ends; null: it ends at the horizon", at_least=0
    )
    batch_size: int = option(
        25, "episodes that run in lockstep and share policy calls; does not change results", at_least=1, free=True
    )
    stream: Literal["test", "validation"] = option("test", "which stream of seeds; no policy is selected on test seeds")
    films: int = option(2, "number of failures to film, and of successes", at_least=0, free=True)


@dataclass(frozen=True)
class EvalOptions(Tested, Seeded, Trusting, EngineOptions, ResumableOutput):
    """Measure a policy's success on unseen seeds; writes eval.json and report.html.

    With EVALUATION, an eval.json or its folder, no policy is evaluated: --replay=SEED runs one of its episodes again
    and films it; two or more, such as parts run on several machines, are merged. --check renders a picture and reports
    whether this machine or container can evaluate.

    Example: manip-il eval --policy.type=expert --eval.n_episodes=200 --output_dir=runs/expert
    """

    first: ClassVar[str] = "policy.path policy.type eval.n_episodes suite robot.type task.type output_dir replay resume"
    evaluation: list[Path] = option(
        list, "evaluations: one with --replay, or several to merge", positional=True, exists=""
    )
    policy: MeasuredPolicyGroup = field(default_factory=MeasuredPolicyGroup)
    env: Given = given(EnvConfig, **OF_POLICY)
    eval: EvalGroup = field(default_factory=EvalGroup)
    until_width: float | None = option(
        None, "stop when the confidence interval is this narrow; 0.02: 2 percentage points", at_least=0.0001, at_most=1
    )
    output_dir: Path = output_folder("runs/eval")
    replay: int | None = option(None, "seed of the episode of EVALUATION to replay", at_least=0, free=True)
    video: Path | None = option(None, "MP4 file for the replay", free=True)
    health: bool = option(False, "check that this machine can evaluate and render", flag="check", free=True)
