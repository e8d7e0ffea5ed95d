"""Journals: one crash-safe MCAP file for every finished episode.

A file is written under a temporary name, synced and renamed, so it is complete or absent. Every
column is kept bit for bit: numbers as an attachment (`<column>.npy`), pictures as messages.
Foxglove shows all messages.
"""

import json
import re
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.records import Attachment, DataEnd, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import foxglove
from manip_il.data.atomic import PARTIAL, write_file
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.schema import IMAGES, check_same_spec, exact_rate
from manip_il.errors import ManipError, warn
from manip_il.mdp import Episode
from manip_il.worlds.contract import EnvironmentSpec

_FORMAT = "2"
_RECORD = "manip_il"  # name of our metadata record
_NPY = ".npy"
_NAME = re.compile(r"episode-(\d{12,})\.mcap")


@dataclass(frozen=True)
class Journal:
    """A folder of journals of one environment."""

    folder: Path
    spec: EnvironmentSpec
    fingerprint: dict[str, Any]

    def encode(self, episode: Episode) -> bytes:
        """Return an episode's journal as bytes; the same episode gives the same bytes.

        Raises `ValueError` for a column that numpy can only pickle.
        """
        stream = BytesIO()
        writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library=_RECORD)
        writer.add_metadata(_RECORD, _to_texts(self, episode))
        times = foxglove.frame_times(len(episode), exact_rate(self.spec.fps))
        channels = foxglove.episode_channels(episode, self.spec)
        foxglove.add_channels(writer, channels, times)
        for key, column in episode.columns.items():
            if not key.startswith(IMAGES):  # pictures are stored as lossless messages
                numbers = BytesIO()
                np.save(numbers, column, allow_pickle=False)
                writer.add_attachment(
                    0, 0, key + _NPY, "application/octet-stream", numbers.getvalue()
                )
        writer.finish()
        return stream.getvalue()

    def store(self, seed: int, content: bytes) -> Path:
        """Write the bytes from `encode` to disk, replacing an earlier file of the seed.

        Return its path.
        """
        path = episode_path(self.folder, seed)
        write_file(path, content)
        return path

    def write(self, episode: Episode) -> Path:
        """Encode and store one episode; return its path."""
        return self.store(episode.seed, self.encode(episode))

    def prepare(self) -> None:
        """Check that episodes can be added to the folder; warn if its fingerprint differs.

        Removes unfinished files of killed writers, so no other writer may be running. Checks the
        first journal only: raises `MismatchError` if it has another robot, task or cameras, and
        what `read_journal` raises.
        """
        for leftover in self.folder.glob(f".episode-*{PARTIAL}"):
            leftover.unlink(missing_ok=True)
        if not (paths := list_episodes(self.folder)):
            return
        there, _ = read_journal(paths[0])
        here, also = f"{self.spec.robot} {self.spec.task}", ("task", "cameras", "image_size")
        check_same_spec(str(self.folder), there.spec, here, self.spec, also)
        warn(
            *compare_fingerprints(
                str(self.folder), there.fingerprint, "this machine", self.fingerprint
            )
        )


def episode_path(folder: Path, seed: int) -> Path:
    """Return the path of a seed's journal."""
    return folder / f"episode-{seed:012d}.mcap"


def list_seeds(folder: Path) -> list[int]:
    """Return the seeds of the folder's finished episodes, in order.

    [] if the folder does not exist.
    """
    return sorted(
        int(match[1])
        for path in folder.glob("episode-*.mcap")
        if (match := _NAME.fullmatch(path.name))
    )


def list_episodes(folder: Path) -> list[Path]:
    """Return the folder's finished episodes in seed order; [] if the folder does not exist."""
    return [episode_path(folder, seed) for seed in list_seeds(folder)]


def read_journal(path: Path) -> tuple[Journal, Episode]:
    """Read an episode, bit for bit, and the description of its environment.

    Raises `ManipError` naming the file if it is truncated, changed, not ours or of an older
    version.
    """
    try:
        with checks.open_outside(path, "a journal") as stream:
            return _read(path.parent, stream)
    # a foreign file with valid checksums can make a parser raise anything
    except Exception as error:
        why = checks.one_line(error) or type(error).__name__
        again = "delete it; --resume=true records it again"
        raise ManipError(f"{path} is not a complete episode: {why}; {again}") from error


def _read(folder: Path, stream: BinaryIO) -> tuple[Journal, Episode]:
    """Read a file and verify its checksums."""
    values: dict[str, Any] = {}
    columns: dict[str, NDArray[Any]] = {}
    for record in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
        if isinstance(record, Metadata) and record.name == _RECORD:
            values = {name: json.loads(text) for name, text in record.metadata.items()}
        elif isinstance(record, Attachment):
            columns[record.name.removesuffix(_NPY)] = np.load(
                BytesIO(record.data), allow_pickle=False
            )
        elif isinstance(record, DataEnd):  # all checksums were verified
            break
    if (found := str(values.pop("format", None))) != _FORMAT:
        raise ValueError(f"its format is {checks.shorten(found)}; this version reads {_FORMAT!r}")
    spec = EnvironmentSpec.from_json(values.pop("spec"))
    journal = Journal(folder, spec, values.pop("fingerprint"))
    del values["frames"]
    pictures = foxglove.read_images(stream, spec.cameras)
    columns |= {IMAGES + camera: taken for camera, taken in pictures.items()}
    return journal, Episode(columns=columns, **values)


def _to_texts(journal: Journal, episode: Episode) -> dict[str, str]:
    """Return everything except the columns as JSON, by name."""
    values: dict[str, Any] = {
        "seed": episode.seed,
        "success": bool(episode.success),
        "success_at_end": bool(episode.success_at_end),
        "frames": len(episode),
        "spec": journal.spec.to_json(),
        "fingerprint": journal.fingerprint,
        "instruction": episode.instruction,
    }
    values |= {"drawn": dict(episode.drawn)} if episode.drawn else {}
    return {"format": _FORMAT} | {name: json.dumps(value) for name, value in values.items()}


def journals_of(root: Path) -> Path:
    """Return the folder next to a dataset that holds its journals; it may not exist."""
    return root.absolute().with_name(f"{root.absolute().name}.journals")
