"""`manip-il data to-mcap` and `manip-il data from-mcap`: datasets to MCAP files and back."""

from __future__ import annotations

from collections import Counter
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import ClassVar

from manip_il.cli.inputs import require_dataset
from manip_il.cli.outputs import prepare_output, require_new, save_options
from manip_il.cli.progress import progress, say
from manip_il.data.atomic import new_folder
from manip_il.errors import UsageError
from manip_il.option import option


@dataclass
class McapExportOptions:
    """Write a LeRobot v3.0 dataset as MCAP, which Foxglove opens: one file per episode, one topic per column.

    With it, mapping.yaml, from which `manip-il data from-mcap` makes the same dataset again.
    """

    example: ClassVar[str] = "manip-il data to-mcap datasets/demos demos_mcap"
    dataset: Path = option(MISSING, "the dataset's folder", positional=True)
    out: Path = option(MISSING, "folder for the files", positional=True)
    overwrite: bool = option(False, "replace an existing export")

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        require_dataset(self.dataset)
        if self.dataset.resolve().is_relative_to(self.out.resolve()):
            raise UsageError(f"{self.out} holds the dataset itself; expected another folder for the files")
        require_new(self.out, overwrite=self.overwrite)

    def run(self) -> None:
        """Export every episode; the folder appears when it is whole."""
        from manip_il.mcap.export import MAPPING, export_dataset, open_source

        info = open_source(self.dataset)
        prepare_output(self.out, resume=False, overwrite=self.overwrite)
        with new_folder(self.out) as folder, progress(info.episodes, "export") as bar:
            count = 0
            for _ in export_dataset(self.dataset, info, folder):
                count += 1
                bar.advance()
            save_options(folder, self)
        say(f"exported {count:,} episodes to {self.out}")
        say(f"back to a dataset: manip-il data from-mcap {self.out} DATASET --mapping={self.out / MAPPING}")


@dataclass
class McapImportOptions:
    """Write MCAP files as a LeRobot v3.0 dataset: one episode per file, in the order of their names.

    The mapping names the topic and the field of every column, and how its messages are resampled to the dataset's rate:
    nearest, hold or interpolate, with a tolerance in seconds. A gap beyond it is an error.
    """

    example: ClassVar[str] = "manip-il data from-mcap demos_mcap datasets/demos --mapping=demos_mcap/mapping.yaml"
    source: Path = option(MISSING, "an MCAP file, or a folder of them", positional=True)
    dataset: Path = option(MISSING, "folder for the dataset", positional=True)
    mapping: Path = option(MISSING, "YAML: columns in terms of topics (see configs/mcap/panda.yaml)")

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        if not self.source.exists():
            raise UsageError(f"{self.source} does not exist; expected an MCAP file, or a folder of them")
        if not self.mapping.is_file():
            raise UsageError(f"{self.mapping} does not exist; expected a mapping file, such as configs/mcap/panda.yaml")
        if self.dataset.exists() and (not self.dataset.is_dir() or any(self.dataset.iterdir())):
            raise UsageError(f"{self.dataset} exists already; choose another folder, or delete it first")

    def run(self) -> None:
        """Import every file; the dataset appears when it is whole."""
        from manip_il.mcap.importing import import_files, list_files
        from manip_il.mcap.mapping import load_mapping

        mapping = load_mapping(self.mapping)
        paths = list_files(self.source)
        counts: Counter[str] = Counter()
        used: Counter[str] = Counter()
        episodes = frames = 0
        with progress(len(paths), "import") as bar:
            for done in import_files(paths, self.dataset, mapping):
                bar.advance()
                counts.update(done.counts)
                used.update(done.used)
                episodes, frames = episodes + 1, frames + done.frames
        say(_table(counts, used))
        say(f"imported {episodes:,} episodes, {frames:,} frames to {self.dataset}")


def _table(counts: Counter[str], used: Counter[str]) -> str:
    """Messages of every topic: how many there are, had a part in the dataset, and had none."""
    width = max(map(len, ["topic", *counts]))
    lines = [f"{'topic':{width}}  {'messages':>10}  {'used':>10}  {'unused':>10}"]
    for topic in sorted(counts):
        rest = counts[topic] - used[topic]
        note = "" if topic in used else "  not in the mapping"
        lines.append(f"{topic:{width}}  {counts[topic]:>10,}  {used[topic]:>10,}  {rest:>10,}{note}")
    return "\n".join(lines)
