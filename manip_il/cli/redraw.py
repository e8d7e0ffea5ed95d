"""`manip-il redraw`: new scenes of the states that a dataset or a DAgger run visited, labelled and pictured."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il.cli import common_options as common
from manip_il.cli.inputs import require_dataset
from manip_il.cli.outputs import check_output, check_same_options, prepare_output, require_output, save_options
from manip_il.cli.progress import progress, say, warn
from manip_il.cli.record import OwnRobotGroup
from manip_il.data.atomic import exclusive
from manip_il.errors import UsageError
from manip_il.option import option
from manip_il.sim.config import CAMERAS

if TYPE_CHECKING:
    from manip_il.collect.redraw import RedrawJob
    from manip_il.collect.source import Source

_RUN = "dataset"  # the folder of a DAgger run that has the states of all its rounds


@dataclass
class RedrawOptions:
    """Draw goals, untouched objects and looks anew in the states that were visited; the expert labels, cameras see.

    TARGET is a LeRobot dataset to train policies on pictures from, each frame an episode of its own. Scenes without a
    sound label are left out. A killed redraw goes on where it was.
    """

    example: ClassVar[str] = "manip-il redraw runs/dagger datasets/redrawn --frames=20000"
    source: Path = option(MISSING, "a dataset of this program, or the folder of a DAgger run", positional=True)
    target: Path = option(MISSING, "folder of the new dataset", positional=True)
    frames: int = option(20_000, "scenes to draw")
    scenes: bool = option(True, "draw goals and objects anew; false: states as they were visited")
    branch_steps: int = option(1, "control steps that the expert drives on from every scene, for act and diffusion")
    robot: OwnRobotGroup = field(default_factory=OwnRobotGroup)
    cameras: list[str] = option(lambda: list(CAMERAS), "any of front, side, wrist")
    image: common.SmallImageGroup = field(default_factory=common.SmallImageGroup)
    vary: list[str] = option(list, "how every frame looks: view, clutter, object (its colour), or YAMLs of ranges")
    seed: int = common.seed_option()
    engine: Literal["local", "ray"] = common.engine_option()
    workers: int | None = common.workers_option()
    resume: bool = option(False, "continue an interrupted redraw")
    overwrite: bool = option(False, "replace an existing dataset")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        if self.frames < 1:
            raise UsageError(f"--frames is {self.frames}; expected at least 1")
        if self.branch_steps < 1:
            raise UsageError(f"--branch_steps is {self.branch_steps}; expected at least 1")
        common.require_workers(self.workers)
        source, target = self._dataset().resolve(), self.target.resolve()
        if source.is_relative_to(target) or target.is_relative_to(source):
            raise UsageError(f"TARGET {self.target} overlaps SOURCE {self.source}; expected a folder of its own")
        check_output(self.target, resume=self.resume, overwrite=self.overwrite)
        if not self.target.is_dir():
            require_output(self._journals(), resume=self.resume, overwrite=self.overwrite)
        if self.image.config(self.cameras) is None:
            raise UsageError(f"--cameras names none; expected any of {', '.join(CAMERAS)}")

    def run(self) -> None:
        """Draw all frames; TARGET appears when they are there."""
        self.make()
        policy = "cnn" if self.branch_steps == 1 else "act --observation=images"
        train = f"manip-il train --dataset.root={self.target} --policy.type={policy}"
        say(f"next: {train} --output_dir=runs/{self.target.name}")

    def make(self) -> None:
        """Draw all frames, and say nothing of what comes next."""
        from manip_il.collect.source import open_source

        source = open_source(self._dataset(), self.robot.type)
        warn(*source.warnings)
        job = self._job(source)
        with exclusive(self.target):
            journals = self._journals()
            prepare_output(self.target, resume=self.resume, overwrite=self.overwrite)
            prepare_output(journals, resume=self.resume, overwrite=self.overwrite)
            if self.resume:
                check_same_options(journals, self, ("workers", "engine"))
                if self.target.is_dir() and not journals.is_dir():
                    require_dataset(self.target)
                    say(f"{self.target} is complete already")
                    return
            save_options(journals, self)
            self._redraw(source, job)

    def _dataset(self) -> Path:
        root = self.source / _RUN if (self.source / _RUN / "meta" / "info.json").is_file() else self.source
        require_dataset(root)
        return root

    def _journals(self) -> Path:
        return self.target.with_name(f"{self.target.name}.journals")

    def _job(self, source: Source) -> RedrawJob:
        from manip_il.collect.redraw import RedrawJob

        cameras = self.image.config(self.cameras)
        assert cameras is not None
        from manip_il.evaluation.suites import varied

        conditions = varied(self.vary, source.env, sees=True)
        return RedrawJob(
            source.env,
            cameras,
            self._journals(),
            self.frames,
            self.seed,
            self.scenes,
            conditions,
            self.branch_steps,
        )

    def _redraw(self, source: Source, job: RedrawJob) -> None:
        from manip_il.collect.record import redraw
        from manip_il.collect.workers import Engine

        asked = self.frames * self.branch_steps
        with progress(asked, f"redraw {source.root}") as bar, Engine(self.workers, self.engine) as engine:
            info = redraw(engine, source.root, job, self.target, lambda episode: bar.advance(len(episode)))
        left = self.frames - info.episodes
        what = f"{', '.join(job.cameras.names)}, {job.cameras.height} x {job.cameras.width} pixels"
        say(
            f"redrew {info.episodes:,} scenes, {info.frames:,} frames: {what}; {left:,} left out, without a sound label"
        )
        say(f"dataset: {self.target}")
