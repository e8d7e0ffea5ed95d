"""`manip-il data render`, `redraw`, `relabel`, `build`, `merge`: a dataset out of one that is there."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli.common_options import DATASET, SMALL, Pictured, Varied, Workers
from manip_il.cli.options import Given, given, group
from manip_il.cli.outputs import Replacing, prepare_output, require_replaceable
from manip_il.cli.progress import progress, say, warn
from manip_il.data.atomic import exclusive
from manip_il.option import Seeded, option
from manip_il.sim.config import CameraConfig, Look

if TYPE_CHECKING:
    from manip_il.collect.edits import Source, Target

_RUN = "dataset"  # the folder of a DAgger run that has the states of all its rounds


@dataclass(frozen=True)
class BuildOptions(Replacing):
    """Build the LeRobot dataset of a folder of journals.

    The same journals give the same bytes, those that record wrote.
    """

    example: ClassVar[str] = "manip-il data build datasets/demos.journals datasets/demos"
    journals: Path = option(MISSING, "folder of episode-*.mcap files", positional=True, exists="")
    dataset: Path = option(MISSING, "folder of the new dataset", positional=True)
    repo_id: str | None = option(None, "USER/NAME on the Hub; by default as recorded")

    def run(self) -> None:
        """Build the dataset."""
        from manip_il.data.build import build

        if self.overwrite and self.dataset.exists():
            require_replaceable(self.dataset, self.overwrite)
        with exclusive(self.dataset):
            info, failed = build(self.journals, self.dataset, repo_id=self.repo_id, replace=self.overwrite)
        say(f"built {info.episodes:,} episodes, {info.frames:,} frames; left out: {failed}")
        say(f"dataset: {self.dataset}")


@dataclass(frozen=True)
class MergeOptions(Replacing):
    """Merge the episodes of several datasets, in the order given, into one.

    Refused if robot, task, rate or cameras differ. Provenance names the sources.
    """

    example: ClassVar[str] = "manip-il data merge datasets/demos datasets/more --output=datasets/both"
    datasets: list[Path] = option(MISSING, DATASET, exists="datasets/", positional=True)
    output: Path = option(MISSING, "folder of the new dataset")

    def run(self) -> None:
        """Merge; the new dataset appears when it is whole."""
        from manip_il.data.build import local_id, merge_datasets

        with exclusive(self.output):
            prepare_output(self.output, overwrite=self.overwrite, sources=self.datasets)
            info = merge_datasets(self.datasets, self.output, repo_id=local_id(self.output.absolute().name))
        say(f"merged {info.episodes:,} episodes, {info.frames:,} frames", f"dataset: {self.output}")


@dataclass(frozen=True)
class Edit(Replacing):
    """Edit of a dataset's states."""

    source: Path = option(MISSING, "a dataset of this program, or of redraw a run", positional=True, exists="datasets/")
    target: Path | None = option(
        None, "folder of the new dataset; by default SOURCE_rendered, _relabelled or _redrawn", positional=True
    )
    robot: str | None = option(None, "its YAML, if the dataset's robot does not ship", flag="robot.type")
    task: str | None = option(None, "its Python file, if the dataset's task does not ship", flag="task.type")
    object: str | None = option(
        None, "mesh:FILE:LENGTH as in the recording, if the dataset's object is a mesh", flag="task.object"
    )
    processes: Workers = group(Workers(), prefix="")

    @contextmanager
    def open(self, what: str, root: Path | None = None, pieces: int | None = None) -> Generator[tuple[Source, Target]]:
        """Yield the dataset to read and the new one's folder to write, held, with the progress of its pieces.

        root: of the dataset, by default `source`. pieces: how many, by default one an episode. Then says where it is.
        """
        from manip_il.collect.edits import Target, open_source
        from manip_il.collect.workers import default_workers

        root = root or self.source
        folder = self.target or root.with_name(f"{root.absolute().name}_{what}")
        if folder.exists() and any(folder.iterdir()):
            require_replaceable(folder, self.overwrite, [root])
        source = open_source(root, self.robot, self.task, self.object)
        warn(*source.warnings)
        with exclusive(folder), progress(pieces or source.dataset.info.episodes, str(folder)) as bar:
            yield source, Target(folder, self.processes.workers or default_workers(), self.overwrite, bar.step)
        say(f"dataset: {folder}")


@dataclass(frozen=True)
class RenderOptions(Edit, Pictured):
    """Render a dataset's stored states: TARGET is SOURCE with other cameras, sizes or lights. Nothing is simulated."""

    example: ClassVar[str] = "manip-il data render datasets/demos datasets/dim --cameras=front --look.brightness=0.6"
    look: Look = field(default_factory=Look)

    def run(self) -> None:
        """Render every episode; TARGET appears when all are there."""
        from manip_il.collect.edits import render_dataset

        with self.open("rendered") as (source, target):
            info = render_dataset(source, self.camera_config(source.env, self.look), target)
            say(f"rendered {info.episodes:,} episodes, {info.frames:,} frames")


@dataclass(frozen=True)
class RelabelOptions(Edit):
    """Relabel every state of a dataset with the current expert, in place of recording again.

    TARGET is SOURCE with other labels: what was executed, pictures and all else stay as they are. States in which the
    expert was not asked are labelled, too. Says how many labels changed: by more than 1 % of a joint's longest step, in
    phase, or in being sound.
    """

    example: ClassVar[str] = "manip-il data relabel datasets/demos"

    def run(self) -> None:
        """Label every state; TARGET appears when all are labelled."""
        from manip_il.collect.edits import relabel_dataset

        with self.open("relabelled") as (source, target):
            changed, info = relabel_dataset(source, target), source.dataset.info
            say(f"relabelled {info.episodes:,} episodes, {info.frames:,} frames: {changed:,} labels differ")


@dataclass(frozen=True, kw_only=True)
class RedrawOptions(Edit, Varied, Seeded):
    """Draw goals, untouched objects and looks anew in the states that were visited; the expert labels, cameras see.

    TARGET is a LeRobot dataset to train policies on pictures from, each frame an episode of its own. Scenes without a
    sound label are left out. --vary takes view, clutter, object (its colour), or YAMLs of ranges.
    """

    example: ClassVar[str] = "manip-il data redraw runs/dagger datasets/redrawn --frames=20000"
    frames: int = option(20_000, "scenes to draw", at_least=1)
    scenes: bool = option(True, "draw goals and objects anew; false: states as they were visited")
    branch_steps: int = option(
        1, "control steps that the expert drives on from every scene, for act and diffusion", at_least=1
    )
    image: Given = given(CameraConfig, **SMALL)

    def run(self) -> None:
        """Draw all frames; TARGET appears when they are there."""
        from manip_il.collect.edits import redraw_dataset
        from manip_il.collect.scenes import CHUNK, Scenes
        from manip_il.evaluation.suites import varied

        root = self.source / _RUN if (self.source / _RUN / "meta" / "info.json").is_file() else self.source
        with self.open("redrawn", root, -(-self.frames // CHUNK)) as (source, target):
            conditions = varied(self.vary, source.env, sees=True)
            cameras = self.camera_config(source.env)
            scenes = Scenes(cameras, self.frames, self.seed, self.scenes, conditions, self.branch_steps)
            info = redraw_dataset(source, scenes, target)
            left, drawn = self.frames - info.episodes, f"{info.episodes:,} scenes, {info.frames:,} frames"
            say(f"redrew {drawn}; {left:,} left out, without a sound label")
        policy = "cnn" if self.branch_steps == 1 else "act --observation=images"
        train = f"manip-il train --dataset.root={target.root} --policy.type={policy}"
        say(f"next: {train} --output_dir=runs/{target.root.name}")
