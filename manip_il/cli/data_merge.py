"""`manip-il data merge`: the episodes of several datasets as one dataset."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import ClassVar

from manip_il.cli.inputs import require_dataset
from manip_il.cli.outputs import require_new
from manip_il.cli.progress import say
from manip_il.data.atomic import exclusive
from manip_il.errors import UsageError
from manip_il.option import option


@dataclass
class DataMergeOptions:
    """Merge the episodes of several datasets, in the order given, into one.

    Refused if robot, task, rate or cameras differ. Provenance names the sources.
    """

    example: ClassVar[str] = "manip-il data merge datasets/demos datasets/more --output=datasets/both"
    datasets: list[Path] = option(MISSING, "two or more folders of datasets", positional=True)
    output: Path = option(MISSING, "folder of the new dataset")
    overwrite: bool = option(False, "replace an existing dataset")

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        if len(self.datasets) < 2:
            raise UsageError(f"{self.datasets[0]} is the only one; expected two or more datasets to merge")
        for path in self.datasets:
            require_dataset(path)
            if path.resolve().is_relative_to(self.output.resolve()):
                raise UsageError(f"--output={self.output} holds the dataset {path}; expected another folder")
        require_new(self.output, overwrite=self.overwrite)

    def run(self) -> None:
        """Merge; the new dataset appears when it is whole."""
        from manip_il.cli.outputs import prepare_output
        from manip_il.data.build import local_id, merge_datasets

        with exclusive(self.output):
            prepare_output(self.output, resume=False, overwrite=self.overwrite)
            info = merge_datasets(self.datasets, self.output, repo_id=local_id(self.output.absolute().name))
        say(f"merged {info.episodes:,} episodes, {info.frames:,} frames")
        say(f"dataset: {self.output}")
