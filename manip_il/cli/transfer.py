"""`manip-il push`, `pull`: move datasets and policies."""

from dataclasses import MISSING, dataclass
from pathlib import Path

from manip_il.cli.common_options import OfDataset
from manip_il.cli.outputs import OutputFile, Replacing, output_file
from manip_il.option import option


@dataclass(frozen=True)
class PushOptions:
    """Push a dataset, or a policy with its run, to the Hugging Face Hub, an object store, another
    machine or a folder.

    A dataset is checked first, as by manip-il data check, and refused if it has errors. Only
    changes are uploaded. Readers see the old version until the new one is complete. After an
    interruption, run the same command again: files that have arrived are not sent again.

    Example: manip-il push datasets/demos hf://datasets/me/demos
    """

    source: Path = option(MISSING, "a dataset, a run or a policy", positional=True)
    remote: str = option(
        MISSING,
        "hf://datasets/USER/NAME, hf://USER/NAME, s3://BUCKET/FOLDER, sftp://HOST/FOLDER,"
        " file://FOLDER",
        positional=True,
    )
    private: bool = option(False, "make a new repository on the Hub private")
    dry_run: bool = option(False, "only list what would be uploaded and removed")


@dataclass(frozen=True)
class PullOptions(Replacing):
    """Pull a dataset or a policy from the Hugging Face Hub, an object store, another machine or a
    folder.

    Before the folder appears, every file is verified by its hash, and every file of a dataset is
    opened once. Paths outside the folder, links, pickles and code are refused; nothing that is
    pulled is executed.

    Example: manip-il pull hf://datasets/me/demos datasets/demos
    """

    remote: str = option(
        MISSING, "the address given to manip-il push, or any Hub repository", positional=True
    )
    target: Path = option(MISSING, "the new folder", positional=True)
    revision: str | None = option(None, "branch, tag or commit of a Hub repository")
    dry_run: bool = option(False, "only list what would be downloaded")


@dataclass(frozen=True)
class ExportOptions(OutputFile):
    """Export an mlp or cnn policy as one file that runs without this package.

    Inputs are raw observations with LeRobot's names; outputs are joint targets [rad] and the
    gripper command [m]. The model is run and compared with the checkpoint before it is written.
    docs/export.md shows how to run it.

    Example: manip-il export runs/dagger --output=policy.onnx
    """

    policy: Path = option(MISSING, "a run, a checkpoint or its pretrained_model", positional=True)
    output: Path = output_file("policy.onnx")


@dataclass(frozen=True)
class McapExportOptions(OfDataset, Replacing):
    """Write a LeRobot v3.0 dataset as MCAP, which Foxglove opens: one file per episode, one topic
    per column.

    Also writes mapping.yaml, with which `manip-il data from-mcap` makes the same dataset again.

    Example: manip-il data to-mcap datasets/demos demos_mcap
    """

    out: Path = option(MISSING, "folder for the MCAP files", positional=True)


@dataclass(frozen=True)
class McapImportOptions:
    """Write MCAP files as a LeRobot v3.0 dataset: one episode per file, in order of file names.

    The mapping names the topic and field of every column, and how its messages are resampled to the
    dataset's rate: nearest or previous, with a tolerance in seconds. A gap longer than the
    tolerance is an error.

    Example: manip-il data from-mcap demos_mcap datasets/demos --mapping=demos_mcap/mapping.yaml
    """

    source: Path = option(MISSING, "an MCAP file, or a folder of them", positional=True)
    dataset: Path = option(MISSING, "folder of the new dataset", positional=True)
    mapping: Path = option(
        MISSING, "YAML file: the topic of every column (see configs/mcap/panda.yaml)"
    )
