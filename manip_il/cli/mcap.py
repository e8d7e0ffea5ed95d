"""`manip-il data to-mcap` and `manip-il data from-mcap`: datasets to MCAP files and back."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import ClassVar

from manip_il.cli.inputs import exists, require_dataset
from manip_il.cli.outputs import check_output, prepare_output, save_options
from manip_il.cli.progress import Progress, say
from manip_il.data.atomic import new_folder
from manip_il.errors import UsageError
from manip_il.option import option


@dataclass
class McapExportOptions:
    """Write a LeRobot v3.0 dataset as MCAP, which Foxglove opens: one file per episode, one topic per column.

    With it, mapping.yaml, from which `manip-il data from-mcap` makes the same dataset again.
    """

    example: ClassVar[str] = "manip-il data to-mcap datasets/demos demos_mcap"
    dataset: Path = option(MISSING, "the dataset's folder", positional=True, check=require_dataset)
    out: Path = option(MISSING, "folder for the files", positional=True)
    overwrite: bool = option(False, "replace an existing export")

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        if self.dataset.resolve().is_relative_to(self.out.resolve()):
            raise UsageError(f"{self.out} holds the dataset itself; expected another folder for the files")
        check_output(self.out, overwrite=self.overwrite)

    def run(self) -> None:
        """Export every episode; the folder appears when it is whole."""
        from manip_il.data.dataset import Dataset
        from manip_il.mcap.export import MAPPING, export_dataset, left_out

        dataset = Dataset.open(self.dataset)
        prepare_output(self.out, overwrite=self.overwrite)
        with new_folder(self.out) as folder, Progress(dataset.info.episodes, "export") as bar:
            for _ in export_dataset(dataset, folder):
                bar.advance()
            save_options(folder, self)
        if missing := left_out(dataset.info):
            say(f"left out, as MCAP has no place for them: {', '.join(missing)}")
        say(f"exported {dataset.info.episodes:,} episodes to {self.out}")
        say(f"back to a dataset: manip-il data from-mcap {self.out} DATASET --mapping={self.out / MAPPING}")


@dataclass
class McapImportOptions:
    """Write MCAP files as a LeRobot v3.0 dataset: one episode per file, in the order of their names.

    The mapping names the topic and the field of every column, and how its messages are resampled to the dataset's rate:
    nearest or previous, with a tolerance in seconds. A gap beyond it is an error.
    """

    example: ClassVar[str] = "manip-il data from-mcap demos_mcap datasets/demos --mapping=demos_mcap/mapping.yaml"
    source: Path = option(
        MISSING, "an MCAP file, or a folder of them", positional=True, check=exists("an MCAP file, or a folder of them")
    )
    dataset: Path = option(MISSING, "folder for the dataset", positional=True)
    mapping: Path = option(
        MISSING, "YAML: columns in terms of topics (see configs/mcap/panda.yaml)", check=exists("a mapping file")
    )

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        if self.dataset.exists() and (not self.dataset.is_dir() or any(self.dataset.iterdir())):
            raise UsageError(f"{self.dataset} exists already; choose another folder, or delete it first")

    def run(self) -> None:
        """Import every file; the dataset appears when it is whole."""
        from manip_il.mcap.importing import import_files, list_files
        from manip_il.mcap.mapping import load_mapping
        from manip_il.mcap.read import read_topics

        mapping = load_mapping(self.mapping)
        paths = list_files(self.source)
        frames = 0
        with Progress(len(paths), "import") as bar:
            for count in import_files(paths, self.dataset, mapping):
                bar.advance()
                frames += count
        wanted = {source.topic for source in mapping.sources.values()}
        if rest := sorted({topic for path in paths for topic in read_topics(path)} - wanted):
            say(f"topics that the mapping does not name: {', '.join(rest)}")
        say(f"imported {len(paths):,} episodes, {frames:,} frames to {self.dataset}")
