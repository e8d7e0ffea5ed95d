"""One crash-safe MCAP file a finished episode: what recording stands on.

A file is written under a temporary name, synced and renamed, so it is whole or it is not there. Every column travels
bit for bit as an attachment (`<column>.npy`); beside it, messages that Foxglove shows as they stand.
"""

from __future__ import annotations

import io
import json
import re
import zlib
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.records import Attachment, DataEnd, Footer, McapRecord, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from manip_il.data import foxglove
from manip_il.data.atomic import PARTIAL, write_file
from manip_il.data.schema import RobotTaskSpec
from manip_il.errors import ManipError
from manip_il.mdp import Episode

_FORMAT = "1"
_RECORD = "manip_il"  # name of our metadata record
_NPY = ".npy"
_NAME = re.compile(r"episode-(\d{12,})\.mcap")
_FOOTER_TAIL = 4 + 8  # the footer's own checksum and the closing magic [bytes]


@dataclass(frozen=True)
class Header:
    """What a journal file says of its episode without its columns."""

    seed: int
    success: bool
    success_at_end: bool
    frames: int
    spec: RobotTaskSpec
    fingerprint: dict[str, Any]


def write_episode(folder: Path, episode: Episode, spec: RobotTaskSpec, fingerprint: dict[str, Any]) -> Path:
    """Write one episode to `folder/episode-<seed>.mcap` and return that path; the same episode gives the same bytes.

    An earlier file of the same seed is replaced. Raises `ManipError` for a column that numpy can only pickle.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"episode-{episode.seed:012d}.mcap"
    write_file(path, _encode(episode, spec, fingerprint))
    return path


def read_episode(path: Path) -> Episode:
    """The episode as it was written, bit for bit; every checksum of the file is checked.

    Raises `ManipError` naming the file where it is cut short, changed, or none of ours.
    """
    with _explain(path):
        records = _checked_records(path.read_bytes())
        header = _header(records)
        attachments = [record for record in records if isinstance(record, Attachment)]
        columns = {record.name.removesuffix(_NPY): _from_npy(record.data) for record in attachments}
        return Episode(header.seed, columns, header.success, header.success_at_end)


def read_header(path: Path) -> Header:
    """Seed, success, spec and fingerprint without reading the columns. Raises `ManipError` naming the file."""
    with _explain(path), path.open("rb") as stream:
        return _header(list(make_reader(stream).iter_metadata()))


def list_episodes(folder: Path) -> list[Path]:
    """The folder's finished episodes in the order of their seeds; none where the folder does not exist."""
    found = [(int(match[1]), path) for path in folder.glob("episode-*.mcap") if (match := _NAME.fullmatch(path.name))]
    return [path for _, path in sorted(found)]


def clean_temporary(folder: Path) -> list[Path]:
    """Remove what killed writers left half-written and return it. Only for when no writer is at work in `folder`."""
    leftovers = sorted(folder.glob(f".episode-*{PARTIAL}"))
    for path in leftovers:
        path.unlink(missing_ok=True)
    return leftovers


def _encode(episode: Episode, spec: RobotTaskSpec, fingerprint: dict[str, Any]) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile="", library=_RECORD)
    writer.add_metadata(
        _RECORD,
        {
            "format": _FORMAT,
            "seed": str(episode.seed),
            "success": json.dumps(bool(episode.success)),
            "success_at_end": json.dumps(bool(episode.success_at_end)),
            "frames": str(len(episode)),
            "spec": json.dumps(spec.to_json()),
            "fingerprint": json.dumps(fingerprint),
        },
    )
    _add_channels(writer, episode, spec)
    for key, column in episode.columns.items():
        writer.add_attachment(0, 0, key + _NPY, "application/octet-stream", _to_npy(episode.seed, key, column))
    writer.finish()
    return stream.getvalue()


def _add_channels(writer: Writer, episode: Episode, spec: RobotTaskSpec) -> None:
    schema_ids: dict[str, int] = {}
    for channel in foxglove.channels(episode, spec):
        title = channel.schema["title"]
        if title not in schema_ids:
            schema_ids[title] = writer.register_schema(title, "jsonschema", json.dumps(channel.schema).encode())
        channel_id = writer.register_channel(channel.topic, "json", schema_ids[title])
        for frame, message in enumerate(channel.messages()):
            time = foxglove.log_time(frame, spec.fps)
            writer.add_message(channel_id, time, message, time, frame)


def _to_npy(seed: int, key: str, column: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    try:
        np.save(stream, column, allow_pickle=False)
    except ValueError as error:
        raise ManipError(f"episode with seed {seed}, column {key!r} of dtype {column.dtype}: {error}") from error
    return stream.getvalue()


def _from_npy(data: bytes) -> NDArray[Any]:
    return np.load(io.BytesIO(data), allow_pickle=False)


def _checked_records(data: bytes) -> list[McapRecord]:
    """All records, once both halves of the file fit their checksums.

    The library's reader checks the first half (data), and only if it meets its closing record.
    """
    records = list(StreamReader(io.BytesIO(data), validate_crcs=True).records)
    ends = [record for record in records if isinstance(record, DataEnd)]
    if len(ends) != 1 or ends[0].data_section_crc == 0:
        raise ValueError("no checksum over its data")
    footer = records[-1]
    summary = data[footer.summary_start : -_FOOTER_TAIL] if isinstance(footer, Footer) else b""
    if not isinstance(footer, Footer) or zlib.crc32(summary) != footer.summary_crc:
        raise ValueError("its summary does not fit its checksum")
    return records


def _header(records: list[Any]) -> Header:
    ours = [record.metadata for record in records if isinstance(record, Metadata) and record.name == _RECORD]
    if len(ours) != 1:
        raise ValueError(f"it holds {len(ours)} metadata records {_RECORD!r}; expected one")
    data = ours[0]
    if data["format"] != _FORMAT:
        raise ValueError(f"its format is {data['format']!r}; this version reads {_FORMAT!r}")
    return Header(
        int(data["seed"]),
        json.loads(data["success"]),
        json.loads(data["success_at_end"]),
        int(data["frames"]),
        RobotTaskSpec.from_json(json.loads(data["spec"])),
        json.loads(data["fingerprint"]),
    )


@contextmanager
def _explain(path: Path) -> Generator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise ManipError(f"no such episode file: {path}") from error
    except Exception as error:  # a damaged file can make a parser raise anything
        why = str(error) or type(error).__name__
        raise ManipError(f"{path} is not a whole episode: {why}; remove it and record that seed again") from error
