"""`manip-il eval`: how often a policy succeeds on unseen seeds.

`manip-il compare`: two policies or runs on the same seeds, with the confidence in their difference,
or a study.

A study runs `manip-il dagger` with several sets of options (its arms), each with the same training
seeds.
"""

from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any, Literal

from manip_il.cli.common_options import OF_POLICY, EngineOptions, PolicyGroup, Tested, Trusting
from manip_il.cli.outputs import ResumableOutput, output_folder
from manip_il.cli.parsing import Given, Open, given
from manip_il.option import Seeded, option
from manip_il.seeding import MAX_SEED
from manip_il.worlds.config import EnvConfig


@dataclass(frozen=True)
class MeasuredPolicyGroup(PolicyGroup):
    """`--policy.*`: the policy to evaluate."""

    device: str = option("cpu", "where the policy runs: cpu or cuda")


@dataclass(frozen=True)
class EvalGroup:
    """`--eval.*`: the episodes to run."""

    n_episodes: int | None = option(
        None,
        "test episodes; by default 100, or up to 10,000 with --until_width",
        at_least=1,
        grows=True,
    )
    hold: int | None = option(
        10,
        "control steps after success until an episode ends; null: it ends at the horizon",
        at_least=0,
    )
    batch_size: int = option(
        25,
        "episodes that run in lockstep and share policy calls; does not change results",
        at_least=1,
        free=True,
    )
    stream: Literal["test", "validation"] = option(
        "test", "which stream of seeds; no policy is selected on test seeds"
    )
    films: int = option(2, "number of failures to film, and of successes", at_least=0, free=True)


@dataclass(frozen=True)
class EvalOptions(Tested, Seeded, Trusting, EngineOptions, ResumableOutput):
    """Measure a policy's success on unseen seeds; writes eval.json and report.html.

    With EVALUATION, an eval.json or its folder, no policy is evaluated: --replay=SEED runs one of
    its episodes again and films it.
    --check renders a picture and reports whether this machine or container can evaluate.

    Example: manip-il eval --policy.type=expert --eval.n_episodes=200 --output_dir=runs/expert
    """

    evaluation: Path | None = option(
        None, "the evaluation of which --replay runs an episode again", positional=True
    )
    policy: MeasuredPolicyGroup = field(default_factory=MeasuredPolicyGroup)
    env: Given = given(EnvConfig, **OF_POLICY)
    eval: EvalGroup = field(default_factory=EvalGroup)
    until_width: float | None = option(
        None,
        "stop when the confidence interval is this narrow; 0.02: 2 percentage points",
        at_least=0.0001,
        at_most=1,
    )
    output_dir: Path = output_folder("runs/eval")
    replay: int | None = option(
        None, "seed of the episode of EVALUATION to replay", at_least=0, free=True
    )
    video: Path | None = option(None, "MP4 file for the replay", free=True)
    health: bool = option(
        False, "check that this machine can evaluate and render", flag="check", free=True
    )


@dataclass(frozen=True)
class TrialGroup:
    """`--eval.*`: the test episodes."""

    n_episodes: int = option(500, "test episodes", at_least=1, grows=True)


@dataclass(frozen=True, kw_only=True)
class ComparisonOptions:
    """Which rounds of the runs are compared, and on how many episodes."""

    checkpoint: Literal["best", "last"] = option(
        "best", "round of a run to test: the best on validation, or the last"
    )
    at: Literal["end", "labels", "episodes", "steps", "seconds"] = option(
        "end",
        "which rounds of a run count: all (end), or those within the number of labels, episodes,"
        " steps or seconds (of collecting and fitting) that every run reached",
    )
    eval: TrialGroup = field(default_factory=TrialGroup)


@dataclass(frozen=True)
class StudyFile(ComparisonOptions):
    """Content of a study's YAML file.

    common: options of `manip-il dagger` that all arms share. arms: name -> options in which an arm
    differs. Arms of different tasks are not compared.
    """

    common: Open = field(default_factory=dict[str, Any])
    arms: Open = field(default_factory=dict[str, Any])
    training_seeds: int = option(
        3, "runs of every arm, one per seed", at_least=1, at_most=MAX_SEED, grows=True
    )
    baseline: str | None = option(None, "the arm to compare others with; by default the first")
    target: float = option(
        0.95, "report what it costs to reach this validation success", at_least=0.0, at_most=1.0
    )


@dataclass(frozen=True)
class CompareOptions(ComparisonOptions, Tested, Seeded, Trusting, EngineOptions, ResumableOutput):
    """Compare two policies, runs, or folders of several training seeds on the same test seeds.

    Or run a whole study.

    Each side is an eval.json, a policy, a run of manip-il dagger, or a folder with one of these per
    training seed (seed_0, seed_1, ...). Two eval.json files are compared directly; other sides are
    evaluated first. Writes compare.json and report.html.

    One YAML file instead of two sides is a study: every arm (a set of options) is trained with
    several seeds, tested on the same unseen seeds, and compared. The file holds `common` and `arms`
    (options of manip-il dagger), training_seeds, eval, checkpoint, at, baseline and target.
    OUTPUT_DIR/ARM/seed_0, seed_1, ... are the runs.

    Example: manip-il compare runs/cloning runs/dagger --at=labels --output_dir=runs/compare
    """

    sides: list[Path] = option(
        MISSING,
        "two sides, each an eval.json, a policy or a run; or the YAML file of a study",
        positional=True,
        free=True,
    )
    env: Given = given(EnvConfig, **OF_POLICY)
    training_seeds: int | None = option(
        None,
        "training seeds of a study, if not its file's; may grow with --resume=true",
        at_least=1,
        free=True,
    )
    output_dir: Path = output_folder("runs/compare")
