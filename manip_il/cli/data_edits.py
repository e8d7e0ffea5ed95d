"""`manip-il data render`, `redraw`, `relabel`, `build`, `merge`: make a dataset from existing ones."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.checks import parse_yaml, shorten
from manip_il.cli.common_options import SMALL, Pictured, Varied
from manip_il.cli.options import Given, given
from manip_il.cli.outputs import Replacing, require_writable
from manip_il.cli.progress import progress, say, warn
from manip_il.data.atomic import exclusive
from manip_il.data.ownership import DATASET
from manip_il.errors import UsageError
from manip_il.evaluation.suites import varied
from manip_il.option import NameOrPath, Seeded, option
from manip_il.sim.config import CameraConfig, Look

if TYPE_CHECKING:
    from manip_il.collect.edits import EditSource, EditTarget

_EXAMPLE = '{"observation.images.top": "observation.images.front"}'
_RUN = "dataset"  # folder of a DAgger run with the states of all rounds


@dataclass(frozen=True)
class BuildOptions(Replacing):
    """Build a LeRobot dataset from a folder of journals.

    The dataset has the same bytes as the one that manip-il record writes with these journals.
    """

    example: ClassVar[str] = "manip-il data build datasets/demos.journals datasets/demos"
    journals: Path = option(MISSING, "folder of episode-*.mcap files", positional=True, exists="")
    dataset: Path = option(MISSING, "folder of the new dataset", positional=True)

    def run(self) -> None:
        """Build the dataset."""
        from manip_il.data.build import build

        require_writable(self.dataset, DATASET, self.overwrite, [self.journals])
        with exclusive(self.dataset):
            info, failed = build(self.journals, self.dataset, replace=self.overwrite)
        say(f"built {info.episodes:,} episodes, {info.frames:,} frames; failed episodes left out: {failed}")
        say(f"dataset: {self.dataset}")


class RenameMap(dict[str, str]):
    """Name of a camera's column -> its new name."""

    @classmethod
    def parse(cls, text: str) -> RenameMap:
        """Read JSON, as for LeRobot's `--rename_map`. Raises `UsageError` if it is something else."""
        with suppress(ValueError):
            if isinstance(found := parse_yaml(text), dict):
                return cls({str(old): str(new) for old, new in found.items()})
        raise UsageError(f"--rename_map is {shorten(text)}; expected {_EXAMPLE}")


@dataclass(frozen=True)
class MergeOptions(Replacing):
    """Merge datasets into one, with their episodes in the order given; or take some episodes, also of a single dataset.

    Every column, every frame's text and all films are copied. Robot, rate, columns and codecs must agree, and the task
    if manip-il recorded it. The provenance of datasets of manip-il names the sources.
    """

    example: ClassVar[str] = "manip-il data merge datasets/demos datasets/more --output=datasets/both"
    datasets: list[Path] = option(MISSING, "LeRobot v3.0 datasets", exists="datasets/", positional=True)
    output: Path = option(MISSING, "folder of the new dataset")
    episodes: list[str] = option(
        list,
        "episodes to take, numbered through all datasets: 0:50 for the first 50, or [0,3,5]; by default all",
        flag="dataset.episodes",
    )
    renamed: RenameMap = option(
        RenameMap,
        f"new names of cameras: {_EXAMPLE}",
        flag="rename_map",
    )

    def run(self) -> None:
        """Merge; the new dataset appears when it is complete."""
        from manip_il.data.build import merge_datasets

        with exclusive(self.output):
            require_writable(self.output, DATASET, self.overwrite, self.datasets)
            part = self.episodes, self.renamed
            info = merge_datasets(self.datasets, self.output, *part, replace=self.overwrite)
        say(f"merged {info.episodes:,} episodes, {info.frames:,} frames", f"dataset: {self.output}")


@dataclass(frozen=True)
class Edit(Replacing):
    """Options for editing a dataset's states."""

    source: Path = option(MISSING, "a manip-il dataset; for redraw, also a run", positional=True, exists="datasets/")
    target: Path | None = option(
        None, "folder of the new dataset; by default SOURCE_rendered, _relabelled or _redrawn", positional=True
    )
    robot: NameOrPath | None = option(None, "YAML file of the dataset's robot, if it is your own", flag="robot.type")
    task: NameOrPath | None = option(None, "Python file of the dataset's task, if it is your own", flag="task.type")
    object: NameOrPath | None = option(
        None, "mesh:FILE:LENGTH as in the recording, if the dataset's object is a mesh", flag="task.object"
    )
    workers: int | None = option(None, "number of processes; by default one per core", at_least=1)

    @contextmanager
    def open(
        self, what: str, root: Path | None = None, pieces: int | None = None
    ) -> Generator[tuple[EditSource, EditTarget]]:
        """Yield the dataset to read and the new dataset's locked folder, and show progress.

        root: the dataset, by default `source`. pieces: total of the progress bar, by default the number of episodes.
        """
        from manip_il.collect.edits import EditTarget, open_source
        from manip_il.collect.workers import default_workers

        root = root or self.source
        folder = self.target or root.with_name(f"{root.absolute().name}_{what}")
        require_writable(folder, DATASET, self.overwrite, [root])
        source = open_source(root, self.robot, self.task, self.object)
        warn(*source.warnings)
        with exclusive(folder), progress(pieces or source.dataset.info.episodes, str(folder)) as bar:
            yield source, EditTarget(folder, self.workers or default_workers(), self.overwrite, bar.step)
        say(f"dataset: {folder}")


@dataclass(frozen=True)
class RenderOptions(Edit, Pictured):
    """Render a dataset's stored states: TARGET is SOURCE with other cameras, sizes or lights. No simulation runs."""

    example: ClassVar[str] = "manip-il data render datasets/demos datasets/dim --cameras=front --look.brightness=0.6"
    look: Look = field(default_factory=Look)

    def run(self) -> None:
        """Render every episode; TARGET appears when it is complete."""
        from manip_il.collect.edits import render_dataset

        with self.open("rendered") as (source, target):
            info = render_dataset(source, self.camera_config(source.env, self.look), target)
            say(f"rendered {info.episodes:,} episodes, {info.frames:,} frames")


@dataclass(frozen=True)
class RelabelOptions(Edit):
    """Relabel every state of a dataset with the current expert, instead of recording again.

    TARGET is SOURCE with new labels; executed actions, pictures and all other columns stay the same. States in which
    the expert was not queried get a label, too. Prints how many labels changed: by more than 1 % of a joint's longest
    step, in phase, or in validity.
    """

    example: ClassVar[str] = "manip-il data relabel datasets/demos"

    def run(self) -> None:
        """Label every state; TARGET appears when it is complete."""
        from manip_il.collect.edits import relabel_dataset

        with self.open("relabelled") as (source, target):
            changed, info = relabel_dataset(source, target), source.dataset.info
            say(f"relabelled {info.episodes:,} episodes, {info.frames:,} frames: {changed:,} labels differ")


@dataclass(frozen=True, kw_only=True)
class RedrawOptions(Edit, Varied, Seeded):
    """Randomise the goals, untouched objects and appearance of visited states; label and render each scene.

    TARGET is a LeRobot dataset for training policies on pictures; each scene is one episode. Scenes without a valid
    label are left out. --vary takes view, clutter, object (its colour), sensing (its noise), or YAML files of
    ranges.
    """

    example: ClassVar[str] = "manip-il data redraw runs/dagger datasets/redrawn --frames=20000"
    frames: int = option(20_000, "number of scenes to draw", at_least=1)
    pictures: bool = option(True, "render the scenes; false: write states only, for --policy.states")
    scenes: bool = option(True, "draw new goals and objects; false: keep the visited states")
    branch_steps: int = option(
        1, "control steps that the expert drives from every scene; more than 1 for act and diffusion", at_least=1
    )
    image: Given = given(CameraConfig, **SMALL)

    def run(self) -> None:
        """Draw all scenes; TARGET appears when it is complete."""
        from manip_il.collect.edits import redraw_dataset
        from manip_il.collect.scenes import CHUNK, Scenes
        from manip_il.tasks.stock.envs import check_cameras

        root = self.source / _RUN if (self.source / _RUN / "meta" / "info.json").is_file() else self.source
        with self.open("redrawn", root, -(-self.frames // CHUNK)) as (source, target):
            conditions = varied(self.vary, source.env, sees=True)
            cameras = self.camera_config(source.env)
            check_cameras(source.env.robot, cameras)  # also if only states are written
            cameras = cameras if self.pictures else None
            scenes = Scenes(cameras, self.frames, self.seed, self.scenes, conditions, self.branch_steps)
            info = redraw_dataset(source, scenes, target)
            left = self.frames - info.episodes
            say(f"redrew {info.episodes:,} scenes, {info.frames:,} frames; {left:,} left out, without a valid label")
