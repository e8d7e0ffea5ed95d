"""`manip-il data render`, `redraw`, `relabel`, `build`, `merge`: a dataset out of one that is there."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli import common_options as common
from manip_il.cli.common_options import exists, require_dataset
from manip_il.cli.options import Given, group
from manip_il.cli.outputs import check_output, prepare_output
from manip_il.cli.progress import progress, say, warn
from manip_il.cli.record import left_out, require_repo_id
from manip_il.data.atomic import exclusive
from manip_il.errors import ManipError, UsageError
from manip_il.option import option
from manip_il.sim.config import Look

if TYPE_CHECKING:
    from manip_il.collect.edits import Source, Target

_RUN = "dataset"  # the folder of a DAgger run that has the states of all its rounds


@dataclass
class BuildOptions:
    """Build the LeRobot dataset of a folder of journals.

    The same journals give the same bytes, those that record wrote. Unreadable journals are reported and left out; the
    exit code is then 1.
    """

    example: ClassVar[str] = "manip-il data build datasets/demos.journals datasets/demos"
    journals: Path = option(
        MISSING, "folder of episode-*.mcap files", positional=True, check=exists("a folder of episode-*.mcap files")
    )
    dataset: Path = option(MISSING, "folder of the dataset", positional=True)
    repo_id: str | None = option(None, "USER/NAME on the Hub; by default as recorded", check=require_repo_id)
    overwrite: bool = option(False, "replace an existing dataset")

    def run(self) -> None:
        """Build the dataset; `ManipError` if a journal could not be read."""
        from manip_il.data.build import build

        check_output(self.dataset, overwrite=self.overwrite)
        with exclusive(self.dataset):
            result = build(self.journals, self.dataset, repo_id=self.repo_id, replace=self.overwrite)
        say(f"built {result.info.episodes:,} episodes, {result.info.frames:,} frames; {left_out(result.failed)}")
        say(f"dataset: {self.dataset}")
        warn(*result.damaged)
        if result.damaged:
            lacks = "the dataset lacks them; record them again by `manip-il record ... --resume=true`"
            raise ManipError(f"journals that could not be read: {len(result.damaged)}; {lacks}")


@dataclass
class MergeOptions:
    """Merge the episodes of several datasets, in the order given, into one.

    Refused if robot, task, rate or cameras differ. Provenance names the sources.
    """

    example: ClassVar[str] = "manip-il data merge datasets/demos datasets/more --output=datasets/both"
    datasets: list[Path] = option(MISSING, "two or more folders of datasets", positional=True, check=require_dataset)
    output: Path = option(MISSING, "folder of the new dataset")
    overwrite: bool = option(False, "replace an existing dataset")

    def run(self) -> None:
        """Merge; the new dataset appears when it is whole."""
        from manip_il.data.build import local_id, merge_datasets

        if len(self.datasets) < 2:
            raise UsageError(f"{self.datasets[0]} is the only one; expected two or more datasets to merge")
        for path in self.datasets:
            check_output(self.output, path, overwrite=self.overwrite)
        with exclusive(self.output):
            prepare_output(self.output, overwrite=self.overwrite)
            info = merge_datasets(self.datasets, self.output, repo_id=local_id(self.output.absolute().name))
        say(f"merged {info.episodes:,} episodes, {info.frames:,} frames", f"dataset: {self.output}")


@dataclass
class EditGroup:
    """Options of every edit of a dataset's states."""

    robot: str | None = option(None, common.OWN_ROBOT_HELP, flag="robot.type")
    task: str | None = option(None, common.OWN_TASK_HELP, flag="task.type")
    object: str | None = option(None, common.OWN_OBJECT_HELP, flag="task.object")
    workers: int | None = common.processes_option()
    overwrite: bool = option(False, "replace an existing dataset")

    @contextmanager
    def open(self, root: Path, folder: Path, what: str, pieces: int | None = None) -> Generator[tuple[Source, Target]]:
        """Yield a dataset to read and the new one's folder to write, held, with the progress of its pieces.

        pieces: how many, by default one an episode. Raises `UsageError` for a folder that may not be written to.
        """
        from manip_il.collect.edits import Target, open_source
        from manip_il.collect.workers import default_workers

        check_output(folder, root, overwrite=self.overwrite)
        source = open_source(root, self.robot, self.task, self.object)
        warn(*source.warnings)
        with exclusive(folder), progress(pieces or source.dataset.info.episodes, what) as bar:
            yield source, Target(folder, self.workers or default_workers(), self.overwrite, bar.step)


@dataclass
class RenderOptions:
    """Render a dataset's stored states: TARGET is SOURCE with other cameras, sizes or lights. Nothing is simulated."""

    example: ClassVar[str] = "manip-il data render datasets/demos datasets/dim --cameras=front --look.brightness=0.6"
    source: Path = option(
        MISSING, "a dataset of this program, with or without pictures", positional=True, check=require_dataset
    )
    target: Path = option(MISSING, "folder of the new dataset", positional=True)
    cameras: list[str] = option(list, f"{common.CAMERAS_HELP}; by default all")
    image: Given = common.image_given()
    look: Look = field(default_factory=Look)
    edit: EditGroup = group(EditGroup(), prefix="")

    def run(self) -> None:
        """Render every episode; TARGET appears when all are there."""
        from manip_il.collect.edits import render_dataset

        with self.edit.open(self.source, self.target, f"render {self.source}") as (source, target):
            cameras = common.camera_config(self.cameras, self.image, self.look, robot=source.env.robot)
            info = render_dataset(source, cameras, target)
        say(f"rendered {info.episodes:,} episodes, {info.frames:,} frames", f"dataset: {self.target}")


@dataclass
class RelabelOptions:
    """Relabel every state of a dataset with the current expert, in place of recording again.

    TARGET is DATASET with other labels: what was executed, pictures and all else stay as they are. States in which the
    expert was not asked are labelled, too. Says how many labels changed.
    """

    example: ClassVar[str] = "manip-il data relabel datasets/demos"
    dataset: Path = option(
        MISSING, "a dataset of this program, with or without pictures", positional=True, check=require_dataset
    )
    target: Path | None = option(None, "folder of the new dataset; by default DATASET_relabelled", positional=True)
    edit: EditGroup = group(EditGroup(), prefix="")

    def run(self) -> None:
        """Label every state; TARGET appears when all are labelled."""
        from manip_il.collect.edits import relabel_dataset

        root = self.target or self.dataset.with_name(f"{self.dataset.absolute().name}_relabelled")
        with self.edit.open(self.dataset, root, f"relabel {self.dataset}") as (source, target):
            changed = relabel_dataset(source, target)
        info, what = source.dataset.info, "all labels are as they were"
        if changed:
            what = f"{changed:,} labels differ: by more than 1 % of a joint's longest step, in phase, or in being sound"
        say(f"relabelled {info.episodes:,} episodes, {info.frames:,} frames: {what}")
        say(f"dataset: {root}")


@dataclass
class RedrawOptions:
    """Draw goals, untouched objects and looks anew in the states that were visited; the expert labels, cameras see.

    TARGET is a LeRobot dataset to train policies on pictures from, each frame an episode of its own. Scenes without a
    sound label are left out.
    """

    example: ClassVar[str] = "manip-il data redraw runs/dagger datasets/redrawn --frames=20000"
    source: Path = option(MISSING, "a dataset of this program, or the folder of a DAgger run", positional=True)
    target: Path = option(MISSING, "folder of the new dataset", positional=True)
    frames: int = option(20_000, "scenes to draw", at_least=1)
    scenes: bool = option(True, "draw goals and objects anew; false: states as they were visited")
    branch_steps: int = option(
        1, "control steps that the expert drives on from every scene, for act and diffusion", at_least=1
    )
    cameras: list[str] = option(list, f"{common.CAMERAS_HELP}; by default all")
    image: Given = common.image_given(small=True)
    vary: list[str] = option(list, "how every frame looks: view, clutter, object (its colour), or YAMLs of ranges")
    seed: int = common.seed_option()
    edit: EditGroup = group(EditGroup(), prefix="")

    def run(self) -> None:
        """Draw all frames; TARGET appears when they are there."""
        from manip_il.collect.edits import redraw_dataset
        from manip_il.collect.scenes import CHUNK, Scenes
        from manip_il.evaluation.suites import varied

        root = self.source / _RUN if (self.source / _RUN / "meta" / "info.json").is_file() else self.source
        require_dataset(root)
        with self.edit.open(root, self.target, f"redraw {root}", -(-self.frames // CHUNK)) as (source, target):
            cameras = common.camera_config(self.cameras, self.image, robot=source.env.robot, small=True)
            conditions = varied(self.vary, source.env, sees=True)
            scenes = Scenes(cameras, self.frames, self.seed, self.scenes, conditions, self.branch_steps)
            info = redraw_dataset(source, scenes, target)
        left, drawn = self.frames - info.episodes, f"{info.episodes:,} scenes, {info.frames:,} frames"
        say(f"redrew {drawn}; {left:,} left out, without a sound label", f"dataset: {self.target}")
        policy = "cnn" if self.branch_steps == 1 else "act --observation=images"
        train = f"manip-il train --dataset.root={self.target} --policy.type={policy}"
        say(f"next: {train} --output_dir=runs/{self.target.name}")
