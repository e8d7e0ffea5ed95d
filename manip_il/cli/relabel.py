"""`manip-il data relabel`: a dataset with the labels that the expert of today gives its states."""

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


@dataclass
class RelabelOptions:
    """Label every state of a dataset anew, by the expert of today, in place of recording again.

    TARGET is DATASET with other labels: what was executed, pictures and all else stay as they are. States in which the
    expert was not asked are labelled, too. Says how many labels changed.
    """

    example: ClassVar[str] = "manip-il data relabel datasets/demos"
    dataset: Path = option(MISSING, "a dataset of this program, with or without pictures", positional=True)
    target: Path | None = option(None, "folder of the new dataset; by default DATASET_relabelled", positional=True)
    robot: OwnRobotGroup = field(default_factory=OwnRobotGroup)
    workers: int | None = option(None, "processes; by default one per core")
    overwrite: bool = option(False, "replace an existing dataset")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        common.require_workers(self.workers)
        require_dataset(self.dataset)
        source, target = self.dataset.resolve(), self._target().resolve()
        if source.is_relative_to(target) or target.is_relative_to(source):
            raise UsageError(f"TARGET {self._target()} overlaps DATASET {self.dataset}; expected a folder of its own")
        require_new(self._target(), overwrite=self.overwrite)

    def run(self) -> None:
        """Label every state; TARGET appears when all are labelled."""
        from manip_il.collect.edits import Target, open_source, relabel_dataset
        from manip_il.collect.workers import default_workers

        target, workers = self._target(), self.workers or default_workers()
        source = open_source(self.dataset, self.robot.type)
        warn(*source.warnings)
        with exclusive(target), progress(source.dataset.info.episodes, f"relabel {self.dataset}") as bar:
            changed = relabel_dataset(source, Target(target, workers, self.overwrite, bar.advance))
        info, what = source.dataset.info, "all labels are as they were"
        if changed:
            what = f"{changed:,} labels differ: by more than 1 % of a joint's longest step, in phase, or in being sound"
        say(f"relabelled {info.episodes:,} episodes, {info.frames:,} frames: {what}")
        say(f"dataset: {target}")

    def _target(self) -> Path:
        folder = self.dataset.absolute()
        return self.target or self.dataset.with_name(f"{folder.name}_relabelled")
