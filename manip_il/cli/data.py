"""`manip-il data render`, `redraw`, `relabel`, `build`, `merge`: make a dataset from existing ones.

`manip-il data check`, `repair`: find errors in a dataset, and repair them.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field
from pathlib import Path

from manip_il.cli.common_options import SMALL, OfDataset, Pictured, Published, Varied
from manip_il.cli.outputs import Output, Replacing, output_folder
from manip_il.cli.parsing import Given, given
from manip_il.option import NameOrPath, Seeded, option
from manip_il.sim.config import CameraConfig, Look


@dataclass(frozen=True)
class BuildOptions(Replacing):
    """Build a LeRobot dataset from a folder of journals.

    The dataset has the same bytes as the one that manip-il record writes with these journals.

    Example: manip-il data build datasets/demos.journals datasets/demos
    """

    journals: Path = option(MISSING, "folder of episode-*.mcap files", positional=True)
    dataset: Path = option(MISSING, "folder of the new dataset", positional=True)


@dataclass(frozen=True)
class MergeOptions(Replacing):
    """Merge datasets into one, with their episodes in the order given.

    Or take some episodes, also of a single dataset.

    Every column, every frame's text and all films are copied. Robot, rate, columns and codecs must
    agree. Datasets of manip-il with different tasks become one of several tasks; the provenance
    names the sources.

    Example: manip-il data merge datasets/demos datasets/more --output=datasets/both
    """

    datasets: list[Path] = option(MISSING, "LeRobot v3.0 datasets", positional=True)
    output: Path = option(MISSING, "folder of the new dataset")
    episodes: list[str] = option(
        list,
        "episodes to take, numbered through all datasets: 0:50 for the first 50, or [0,3,5]; by"
        " default all",
        flag="dataset.episodes",
    )


@dataclass(frozen=True)
class Edit(Replacing):
    """Options for editing a dataset's states."""

    source: Path = option(MISSING, "a manip-il dataset; for redraw, also a run", positional=True)
    target: Path | None = option(
        None,
        "folder of the new dataset; by default SOURCE_rendered, _relabelled, _annotated or"
        " _redrawn",
        positional=True,
    )
    robot: NameOrPath | None = option(
        None,
        "YAML file of the dataset's robot, or Python file of its world, if it is your own",
        flag="robot.type",
        alias="env.type",
    )
    task: NameOrPath | None = option(
        None,
        "Python file of the dataset's task, if it is your own",
        flag="task.type",
        alias="env.task",
    )
    object: NameOrPath | None = option(
        None,
        "mesh:FILE:LENGTH as in the recording, if the dataset's object is a mesh",
        flag="task.object",
    )
    workers: int | None = option(None, "number of processes; by default one per core", at_least=1)


@dataclass(frozen=True)
class RenderOptions(Edit, Pictured):
    """Render a dataset's stored states: TARGET is SOURCE with other cameras, sizes or lights.

    No simulation runs.

    Example: manip-il data render datasets/demos datasets/dim --cameras=front --look.brightness=0.6
    """

    look: Look = field(default_factory=Look)


@dataclass(frozen=True)
class RelabelOptions(Edit):
    """Relabel every state of a dataset with the current expert, instead of recording again.

    TARGET is SOURCE with new labels; executed actions, pictures and all other columns stay the
    same. States in which the expert was not queried get a label, too.

    Example: manip-il data relabel datasets/demos
    """


@dataclass(frozen=True)
class AnnotateOptions(Edit):
    """Add texts that are true of every frame: LeRobot's columns of language.

    Subtasks, what is left, what is done, how the hand moves, other words for the task, where the
    expert takes over from a policy, and, with cameras, questions with answers. They come from the
    states and the expert, not from a model.

    Example: manip-il data annotate datasets/demos
    """


@dataclass(frozen=True, kw_only=True)
class RedrawOptions(Edit, Varied, Seeded):
    """Randomise the goals, untouched objects and appearance of visited states.

    Label and render each scene.

    TARGET is a LeRobot dataset for training policies on pictures; each scene is one episode. Scenes
    without a valid label are left out. --vary takes view, clutter, object (its colour), sensing
    (its noise), or YAML files of ranges.

    Example: manip-il data redraw runs/dagger datasets/redrawn --frames=20000
    """

    frames: int = option(20_000, "number of scenes to draw", at_least=1)
    pictures: bool = option(
        True, "render the scenes; false: write states only, for --policy.states"
    )
    scenes: bool = option(True, "draw new goals and objects; false: keep the visited states")
    branch_steps: int = option(
        1,
        "control steps that the expert drives from every scene; more than 1 for act and diffusion",
        at_least=1,
    )
    image: Given = given(CameraConfig, **SMALL)


@dataclass(frozen=True)
class CheckOptions(OfDataset):
    """Check any LeRobot v3.0 dataset: files, rows, video frames, statistics, and whether a policy
    can learn from it.

    Prints one line per finding, with what to do. The exit code is 1 if there are errors, 0 if only
    warnings.

    Example: manip-il data check datasets/demos
    """

    model: Published | None = option(
        None, "also tell what this model would miss if it is fine-tuned on the dataset", flag="for"
    )


@dataclass(frozen=True)
class RepairOptions(OfDataset):
    """Compute a dataset's counts and statistics again if they are wrong.

    Replaced files are kept in DATASET.before-repair. Then the dataset is checked again.

    Example: manip-il data repair datasets/demos
    """


@dataclass(frozen=True)
class ScoreOptions(OfDataset, Output):
    """Score every frame and episode of a dataset by a reward, and list the worst episodes.

    Writes scores.json, and rabc.parquet with the frames' weights for manip-il train --weights= and
    lerobot-train --sample_weighting.progress_path=.

    Example: manip-il data score datasets/demos --reward=runs/reward --output_dir=runs/scores
    """

    reward: str = option(
        MISSING, "a folder from manip-il reward fit or rl airl, or progress for the true progress"
    )
    output_dir: Path = output_folder("runs/scores")
