"""`manip-il render`: the same episodes with other cameras, sizes or lights."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from manip_il.cli.folders import require_ours
from manip_il.cli.groups import ImageGroup, LookGroup, option, warn
from manip_il.cli.paths import require_dataset, require_workers
from manip_il.cli.progress import progress, say
from manip_il.errors import UsageError


@dataclass
class RenderOptions:
    """Render a dataset's stored states: TARGET is SOURCE with other cameras, sizes or lights. Nothing is simulated."""

    example: ClassVar[str] = "manip-il render datasets/demos datasets/demos_dim --cameras=front --look.brightness=0.6"
    source: Path = field(metadata={"help": "a dataset of this program, with or without pictures", "positional": True})
    target: Path = field(metadata={"help": "folder of the new dataset", "positional": True})
    cameras: list[str] = field(default_factory=lambda: ["front", "wrist"], metadata={"help": "front, wrist or both"})
    image: ImageGroup = field(default_factory=ImageGroup)
    look: LookGroup = field(default_factory=LookGroup)
    workers: int | None = option(None, "processes; by default one per core")
    overwrite: bool = option(False, "replace an existing dataset")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        require_workers(self.workers)
        require_dataset(self.source)
        self._check()
        self.image.config(self.cameras, self.look.config())

    def run(self) -> None:
        """Render every episode; TARGET appears when all are there."""
        cameras = self.image.config(self.cameras, self.look.config())
        if cameras is None:
            raise UsageError("--cameras names none; expected front, wrist or both")
        from manip_il.data.atomic import exclusive
        from manip_il.data.build import local_id
        from manip_il.data.lerobot_read import dataset_info
        from manip_il.engine.engine import default_workers
        from manip_il.engine.render import open_source, render_dataset

        source = open_source(self.source)
        warn(source.warnings)
        with exclusive(self.target), progress(dataset_info(self.source).episodes, f"render {self.source}") as bar:
            info = render_dataset(
                source,
                self.target,
                cameras,
                repo_id=local_id(self.target.name),
                workers=self.workers or default_workers(),
                replace=self.overwrite,
                on_episode=lambda _: bar.advance(),
            )
        what = f"{', '.join(cameras.names)}, {cameras.height} x {cameras.width} pixels"
        say(f"rendered {info.episodes:,} episodes, {info.frames:,} frames: {what}")
        say(f"dataset: {self.target}")

    def _check(self) -> None:
        source, target = self.source.resolve(), self.target.resolve()
        if source.is_relative_to(target) or target.is_relative_to(source):
            raise UsageError(f"TARGET {self.target} overlaps SOURCE {self.source}; expected a folder of its own")
        if self.target.exists() and (not self.target.is_dir() or any(self.target.iterdir())):
            if not self.overwrite:
                raise UsageError(f"{self.target} exists already; replace it with --overwrite=true")
            require_ours(self.target)
