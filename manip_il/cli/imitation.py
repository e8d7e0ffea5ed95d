"""`manip-il train`: behaviour cloning on datasets, with our policies and LeRobot's.

`manip-il record`: a dataset of the expert's demonstrations.

`manip-il dagger`: roll out, label, aggregate, refit, and repeat.

`manip-il demo`: demonstrations, cloning, DAgger, and a report that compares them.
"""

from dataclasses import dataclass, field
from pathlib import Path

from manip_il.algorithms.config import Method, RunConfig
from manip_il.cli.common_options import (
    SMALL,
    DatasetRoots,
    EngineOptions,
    Published,
    Trusting,
    Varied,
)
from manip_il.cli.outputs import Resumable, ResumableOutput, output_folder
from manip_il.cli.parsing import Given, given
from manip_il.data.video_config import VideoConfig
from manip_il.learn.fit_config import FitConfig
from manip_il.option import Seeded, option
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import EnvConfig

RANK = "RANK"  # environment variable with the process's index in distributed training


@dataclass(frozen=True)
class SourceGroup(DatasetRoots):
    """`--dataset.*`: the training data and its weights."""

    weights: list[float] = option(
        list, "share of the samples from each dataset; by default its share of frames"
    )


@dataclass(frozen=True)
class TrainOptions(Seeded, Trusting, ResumableOutput):
    """Fit a policy to the labels of one or more datasets of one robot (behaviour cloning).

    --policy.type is mlp, cnn or any LeRobot policy (act, diffusion, vqbet, ...); its options have
    LeRobot's names: manip-il train --policy.type=act --help lists them.
    OUTPUT_DIR/checkpoints/last/pretrained_model is a LeRobot checkpoint.

    Example: manip-il train --dataset.root=datasets/demos --policy.type=act --observation=state
    --output_dir=runs/act
    """

    dataset: SourceGroup
    weights: Path | None = option(
        None,
        "rabc.parquet from manip-il data score: sampling weights of frames, as in LeRobot's RA-BC",
    )
    fit: Given = given(FitConfig, prefix="")
    output_dir: Path = output_folder("runs/train")


@dataclass(frozen=True)
class DatasetGroup:
    """`--dataset.*`: the recorded dataset."""

    repo_id: str | None = option(
        None, "USER/NAME on the Hub; by default local/ROBOT_TASK", free=True
    )
    root: Path | None = option(None, "folder of the dataset; by default datasets/NAME", free=True)
    num_episodes: int = option(50, "number of successful episodes", at_least=1, grows=True)
    shares: list[float] = option(
        list, "episodes of each of several tasks, relative to the others; by default equally many"
    )
    rgb_encoder: Given = given(VideoConfig)


@dataclass(frozen=True)
class RecordOptions(Varied, Seeded, EngineOptions, Resumable):
    """Record successful demonstrations of the expert as a LeRobot dataset.

    Every finished episode is written to ROOT.journals at once; the dataset appears when all
    episodes are recorded. --resume=true continues a recording; --dataset.num_episodes may then be
    larger.

    Example: manip-il record --dataset.num_episodes=100 --dataset.root=datasets/demos
    """

    env: Given = given(EnvConfig)
    dataset: DatasetGroup = field(default_factory=DatasetGroup)
    preset: Published | None = option(
        None, "cameras, pictures, rate and texts as this model wants them for fine-tuning"
    )
    language: bool = option(
        False, "add texts that are true of every frame, as manip-il data annotate does"
    )


_OF_FIT = (
    "policy",
    "action_space",
    "observation",
    "steps",
    "batch_size",
    "lr",
    "optimizer",
    "scheduler",
)


@dataclass(frozen=True)
class DaggerOptions(Varied, Trusting, EngineOptions, ResumableOutput):
    """Roll out the policy, query the expert in every visited state, aggregate, refit, and repeat.

    Round 0 is behaviour cloning on new demonstrations of the expert, or on those in --dataset.root.
    With --policy.path round 0 is that policy, and only the demonstrations in --dataset.root are
    used. --policy.type is mlp, cnn or any LeRobot policy, with the options of `manip-il train`.
    OUTPUT_DIR/best holds the round with the highest validation success.

    Example: manip-il dagger --rounds=5 --episodes_per_round=50 --output_dir=runs/dagger
    """

    env: Given = given(EnvConfig)
    method: Method = option(
        "dagger",
        "who drives after round 0: the learner (dagger), the expert (cloning), or the expert with"
        " noise like the learner's errors (dart)",
    )
    dataset: DatasetRoots = field(default_factory=lambda: DatasetRoots([]))
    settings: Given = given(RunConfig, prefix="")
    query: str | None = option(
        None,
        "steps in which the expert is queried: every, one (per episode), probability:P,"
        " ensemble:BOUND, safety:BOUND; by default every; for --label=takeover: one; for"
        " --label=branch: probability:1/BRANCH_STEPS",
    )
    fit: Given = given(FitConfig, prefix="", only=_OF_FIT, fixed=("steps",))
    image: Given = given(CameraConfig, **SMALL)
    output_dir: Path = output_folder("runs/dagger")


# replace the defaults of dagger
RUN: Given = {"demonstrations": 100, "rounds": 3, "validation_episodes": 100}
FIT: Given = {"steps": 3_000, "batch_size": 256}


@dataclass(frozen=True)
class DemoOptions(EngineOptions, ResumableOutput):
    """Run a small complete example: the expert demonstrates, a policy is cloned, DAgger improves
    it.

    Compares the expert, the cloned policy, a policy cloned from as many labels of disturbed
    demonstrations as DAgger used, and DAgger's best round on the same unseen seeds, undisturbed and
    disturbed; OUTPUT_DIR/report.html shows the result. The policies are mlps; for other kinds use
    manip-il train and manip-il dagger.

    Example: manip-il demo --output_dir=runs/demo
    """

    env: Given = given(EnvConfig)
    settings: Given = given(
        RunConfig, prefix="", only=(*RUN, "episodes_per_round", "disturbed_share", "seed"), **RUN
    )
    fit: Given = given(FitConfig, prefix="", only=("policy", *FIT), fixed=("steps",), **FIT)
    test_episodes: int = option(
        200, "unseen test episodes, which never select a policy", at_least=1
    )
    disturbed_episodes: int = option(
        100, "test episodes that are also run with disturbances", at_least=1
    )
    output_dir: Path = output_folder("runs/demo")
