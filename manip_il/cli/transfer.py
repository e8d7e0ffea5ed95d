"""`manip-il push`, `pull`, `export`, `data to-mcap`, `from-mcap`: move and convert datasets and policies."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import ClassVar

from manip_il.cli.common_options import OfDataset
from manip_il.cli.options import group
from manip_il.cli.outputs import OutputFile, Replacing, kind_of_output, prepare_output, save_options
from manip_il.cli.progress import has_bars, progress, say, say_next
from manip_il.data.atomic import new_folder, write_file
from manip_il.errors import ManipError
from manip_il.evaluation.policy_folder import find_policy
from manip_il.option import option

EXPORTABLE = ("mlp", "cnn")


@dataclass(frozen=True)
class PushOptions:
    """Push a dataset, or a policy with its run, to the Hugging Face Hub, an object store, another machine or a folder.

    A dataset is checked first, as by manip-il data check, and refused if it has errors. Only changes are uploaded.
    Readers see the old version until the new one is complete. After an interruption, run the same command again: files
    that have arrived are not sent again.
    """

    example: ClassVar[str] = "manip-il push datasets/demos hf://datasets/me/demos"
    source: Path = option(MISSING, "a dataset, a run or a policy", positional=True, exists="")
    remote: str = option(
        MISSING,
        "hf://datasets/USER/NAME, hf://USER/NAME, s3://BUCKET/FOLDER, sftp://HOST/FOLDER, file://FOLDER",
        positional=True,
    )
    journals: bool = option(False, "include the journals, from which the dataset can be rebuilt")
    private: bool = option(False, "make a new repository on the Hub private")
    dry_run: bool = option(False, "only list what would be uploaded and removed")

    def run(self) -> None:
        """Check, list, upload, switch to the new version; print what was done."""
        from rich import filesize

        from manip_il.store.transfer import open_remote, push

        remote = open_remote(self.remote, private=self.private, quiet=not has_bars())
        plan = push(self.source, remote, journals=self.journals, dry_run=self.dry_run)
        size = filesize.decimal(sum(plan.manifest.files[path].size for path in plan.upload))
        if self.dry_run:
            say(*(f"upload   {path}" for path in plan.upload), *(f"remove   {path}" for path in plan.remove))
        done = "would be " if self.dry_run else ""
        say(f"{remote.name}: {len(plan.upload)} files, {size}, {done}uploaded; {len(plan.remove)} {done}removed")
        if not self.dry_run:
            say_next("pull", remote.name, "FOLDER")


@dataclass(frozen=True)
class PullOptions(Replacing):
    """Pull a dataset or a policy from the Hugging Face Hub, an object store, another machine or a folder.

    Before the folder appears, every file is verified by its hash, and every file of a dataset is opened once. Paths
    outside the folder, links, pickles and code are refused; nothing that is pulled is executed.
    """

    example: ClassVar[str] = "manip-il pull hf://datasets/me/demos datasets/demos"
    remote: str = option(MISSING, "the address given to manip-il push, or any Hub repository", positional=True)
    target: Path = option(MISSING, "the new folder", positional=True)
    revision: str | None = option(None, "branch, tag or commit of a Hub repository")
    dry_run: bool = option(False, "only list what would be downloaded")

    def run(self) -> None:
        """Download and verify the files, move the folder into place, and print what was pulled."""
        from rich import filesize

        from manip_il.store.transfer import open_remote, pull

        remote = open_remote(self.remote, revision=self.revision, quiet=not has_bars())
        manifest = pull(remote, self.target, overwrite=self.overwrite, dry_run=self.dry_run)
        if self.dry_run:
            say(*(f"pull     {path}" for path in manifest.files))
        size = filesize.decimal(sum(file.size for file in manifest.files.values()))
        done = "would be downloaded" if self.dry_run else "all verified"
        say(f"{self.target}: a {manifest.kind} of {len(manifest.files)} files, {size}, {done}")


@dataclass(frozen=True)
class ExportOptions:
    """Export an mlp or cnn policy as one file that runs without this package.

    Inputs are raw observations with LeRobot's names; outputs are joint targets [rad] and the gripper command [m]. The
    model is run and compared with the checkpoint before it is written. docs/export.md shows how to run it.
    """

    example: ClassVar[str] = "manip-il export runs/dagger --output=policy.onnx"
    policy: Path = option(MISSING, "a run, a checkpoint or its pretrained_model", positional=True, exists="")
    file: OutputFile = group(OutputFile(Path("policy.onnx")), prefix="")

    def run(self) -> None:
        """Export, compare, write."""
        from manip_il.learn.checkpoint import read_config
        from manip_il.learn.export import export_onnx

        self.file.check()
        path = find_policy(self.policy)
        if (kind := read_config(path)["type"]) not in EXPORTABLE:
            raise ManipError(f"{path} is a policy of type {kind!r}; only {' and '.join(EXPORTABLE)} can be exported")
        try:
            content, difference = export_onnx(path)
        except ImportError as error:
            raise ManipError(f"an ONNX file needs {error.name}: pip install 'manip_il[export]'") from error
        write_file(self.file.output, content)
        say(f"largest difference from {path} over random observations: {difference:.1e}")
        say(f"exported: {self.file.output} ({len(content):,} bytes)")


@dataclass(frozen=True)
class McapExportOptions(OfDataset, Replacing):
    """Write a LeRobot v3.0 dataset as MCAP, which Foxglove opens: one file per episode, one topic per column.

    Also writes mapping.yaml, with which `manip-il data from-mcap` makes the same dataset again.
    """

    example: ClassVar[str] = "manip-il data to-mcap datasets/demos demos_mcap"
    out: Path = option(MISSING, "folder for the MCAP files", positional=True)

    def run(self) -> None:
        """Export every episode; the folder appears when it is complete."""
        from manip_il.data.dataset import Dataset
        from manip_il.mcap.export import MAPPING, export_dataset, left_out

        dataset = Dataset.open(self.dataset)
        prepare_output(self.out, kind_of_output(self), overwrite=self.overwrite, sources=[self.dataset])
        with new_folder(self.out) as folder, progress(dataset.info.episodes, "export") as bar:
            for _ in export_dataset(dataset, folder):
                bar.step()
            save_options(folder, self)
        if missing := left_out(dataset.info):
            say(f"left out, because MCAP cannot hold them: {', '.join(missing)}")
        say(f"exported {dataset.info.episodes:,} episodes to {self.out}")
        say_next("data", "from-mcap", self.out, "DATASET", f"--mapping={self.out / MAPPING}", what="to convert back")


@dataclass(frozen=True)
class McapImportOptions:
    """Write MCAP files as a LeRobot v3.0 dataset: one episode per file, in order of file names.

    The mapping names the topic and field of every column, and how its messages are resampled to the dataset's rate:
    nearest or previous, with a tolerance in seconds. A gap longer than the tolerance is an error.
    """

    example: ClassVar[str] = "manip-il data from-mcap demos_mcap datasets/demos --mapping=demos_mcap/mapping.yaml"
    source: Path = option(MISSING, "an MCAP file, or a folder of them", positional=True, exists="")
    dataset: Path = option(MISSING, "folder of the new dataset", positional=True)
    mapping: Path = option(MISSING, "YAML file: the topic of every column (see configs/mcap/panda.yaml)", exists="")

    def run(self) -> None:
        """Import every file; the dataset appears when it is complete."""
        from manip_il.mcap.importing import import_files, list_files
        from manip_il.mcap.mapping import load_mapping

        paths, frames = list_files(self.source), 0
        with progress(len(paths), "import") as bar:
            for count in import_files(paths, self.dataset, load_mapping(self.mapping)):
                bar.step()
                frames += count
        say(f"imported {len(paths):,} episodes, {frames:,} frames to {self.dataset}")
