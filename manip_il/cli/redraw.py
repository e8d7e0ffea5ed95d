"""`manip-il data redraw`: new scenes of the states that a dataset or a DAgger run visited, labelled and pictured."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import ClassVar

from manip_il.cli import common_options as common
from manip_il.cli.inputs import require_dataset
from manip_il.cli.outputs import require_new
from manip_il.cli.progress import progress, say, warn
from manip_il.cli.record import OwnRobotGroup
from manip_il.data.atomic import exclusive
from manip_il.errors import UsageError
from manip_il.option import option
from manip_il.sim.config import CAMERAS

_RUN = "dataset"  # the folder of a DAgger run that has the states of all its rounds


@dataclass
class RedrawOptions:
    """Draw goals, untouched objects and looks anew in the states that were visited; the expert labels, cameras see.

    TARGET is a LeRobot dataset to train policies on pictures from, each frame an episode of its own. Scenes without a
    sound label are left out.
    """

    example: ClassVar[str] = "manip-il data redraw runs/dagger datasets/redrawn --frames=20000"
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
    workers: int | None = option(None, "processes; by default one per core")
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
        require_new(self.target, overwrite=self.overwrite)
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
        from manip_il.collect.edits import Target, open_source, redraw_dataset
        from manip_il.collect.scenes import CHUNK, Scenes
        from manip_il.collect.workers import default_workers
        from manip_il.evaluation.suites import varied

        source, cameras = open_source(self._dataset(), self.robot.type), self.image.config(self.cameras)
        warn(*source.warnings)
        assert cameras is not None
        conditions, workers = varied(self.vary, source.env, sees=True), self.workers or default_workers()
        scenes = Scenes(cameras, self.frames, self.seed, self.scenes, conditions, self.branch_steps)
        with exclusive(self.target), progress(self.frames, f"redraw {self._dataset()}") as bar:
            target = Target(self.target, workers, self.overwrite, lambda: bar.advance(CHUNK))
            info = redraw_dataset(source, scenes, target)
        left = self.frames - info.episodes
        what = f"{', '.join(cameras.names)}, {cameras.height} x {cameras.width} pixels"
        say(
            f"redrew {info.episodes:,} scenes, {info.frames:,} frames: {what}; {left:,} left out, without a sound label"
        )
        say(f"dataset: {self.target}")

    def _dataset(self) -> Path:
        root = self.source / _RUN if (self.source / _RUN / "meta" / "info.json").is_file() else self.source
        require_dataset(root)
        return root
