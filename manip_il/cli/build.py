"""`manip-il build`: the dataset of a folder of journals, again."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from manip_il.cli.folders import require_ours
from manip_il.cli.groups import option, warn
from manip_il.cli.paths import require_folder
from manip_il.cli.progress import say
from manip_il.cli.record import left_out, require_repo_id
from manip_il.errors import ManipError, UsageError


@dataclass
class BuildOptions:
    """Build the LeRobot dataset of a folder of journals.

    The same journals give the same bytes, those that record wrote. Unreadable journals are reported and left out; the
    exit code is then 1.
    """

    example: ClassVar[str] = "manip-il build datasets/demos.journals datasets/demos"
    journals: Path = field(metadata={"help": "folder of episode-*.mcap files", "positional": True})
    dataset: Path = field(metadata={"help": "folder of the dataset", "positional": True})
    repo_id: str | None = option(None, "USER/NAME on the Hub; by default as recorded")
    overwrite: bool = option(False, "replace an existing dataset")

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        require_folder(self.journals, "one of episode-*.mcap files")
        if self.dataset.exists() and (not self.dataset.is_dir() or any(self.dataset.iterdir())):
            if not self.overwrite:
                raise UsageError(f"{self.dataset} exists already; replace it with --overwrite=true")
            require_ours(self.dataset)
        if self.repo_id is not None:
            require_repo_id("--repo_id", self.repo_id)

    def run(self) -> None:
        """Build."""
        from manip_il.data.atomic import exclusive
        from manip_il.data.build import build

        with exclusive(self.dataset):
            result = build(self.journals, self.dataset, repo_id=self.repo_id, replace=self.overwrite)
        say(f"built {result.info.episodes:,} episodes, {result.info.frames:,} frames; {left_out(result.failed)}")
        say(f"dataset: {self.dataset}")
        warn(result.damaged)
        if result.damaged:
            raise ManipError(
                f"{len(result.damaged)} journal{'s' if len(result.damaged) > 1 else ''} could not be read: the dataset "
                "lacks them; record them again by `manip-il record ... --resume=true`"
            )
