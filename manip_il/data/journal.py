"""Journals: one crash-safe MCAP file for every finished episode.

A file is written under a temporary name, synced and renamed, so it is whole or not there. Every column is kept bit for
bit: numbers as an attachment (`<column>.npy`), pictures as messages. Foxglove shows all messages.
"""

from __future__ import annotations

import io
import itertools
import math
import os
import re
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Metadata
from mcap.writer import CompressionType, Writer
from numpy.lib import format as npy
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import foxglove, schema
from manip_il.data.atomic import PARTIAL, write_file
from manip_il.data.episodes import Header, final_columns, take_final
from manip_il.data.mcap_records import (
    MIB,
    Budget,
    Record,
    check_both_sums,
    chunk_records,
    read_records,
    to_attachment,
    unpack,
)
from manip_il.data.schema import IMAGES, RobotTaskSpec
from manip_il.errors import ManipError, OlderSchemaError
from manip_il.mdp import Episode

_FORMAT = "2"
_RECORD = "manip_il"  # name of our metadata record
_NPY = ".npy"
_DAMAGED = ".damaged"
_NAME = re.compile(r"episode-(\d{12,})\.mcap")
LARGEST_EPISODE = 640 * MIB  # all columns and pictures [bytes]: 6,800 frames of two cameras of 128 x 128 pixels
_LARGEST_RATIO = 256  # or so many times the file's size, where that is more: rendered frames reach about 50
_MOST_COLUMNS = 1_000
_LONGEST_NPY_HEADER = 20_000  # [bytes]; numpy refuses what is longer than 10,000
_NPY_HEADERS: dict[tuple[int, int], Callable[[io.BytesIO], Any]] = {
    (1, 0): npy.read_array_header_1_0,
    (2, 0): npy.read_array_header_2_0,
}


@dataclass(frozen=True)
class Journal:
    """Writes the journal of every episode that an engine runs."""

    folder: Path
    spec: RobotTaskSpec
    fingerprint: dict[str, Any]

    def pack(self, episode: Episode) -> bytes:
        """Return the content of an episode's journal."""
        return encode_episode(episode, self.spec, self.fingerprint)

    def store(self, seed: int, packed: bytes) -> None:
        """Write the journal to disk. Raises `ManipError` where the disk is full or may not be written."""
        path = episode_path(self.folder, seed)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_file(path, packed)
        except OSError as error:
            raise ManipError(f"cannot write {path}: {error.strerror}") from error


def write_episode(folder: Path, episode: Episode, spec: RobotTaskSpec, fingerprint: dict[str, Any]) -> Path:
    """Write one episode to `folder/episode-<seed>.mcap` and return that path; the same episode gives the same bytes.

    An earlier file of the same seed is replaced. Raises `ManipError` for a column that numpy can only pickle, and
    where the disk is full or may not be written.
    """
    keep = Journal(folder, spec, fingerprint)
    keep.store(episode.seed, keep.pack(episode))
    return episode_path(folder, episode.seed)


def read_episode(path: Path) -> Episode:
    """Return the episode of `read_journal`."""
    return read_journal(path)[1]


def read_journal(path: Path) -> tuple[Header, Episode]:
    """Return the header and the episode as they were written, bit for bit; every checksum of the file is checked.

    Raises `ManipError` naming the file where it is cut short, changed, or none of ours.
    """
    with _explain(path), open(checks.open_regular(path), "rb") as stream:
        check_both_sums(stream)
        header = _header(stream)
        budget = _budget(stream)
        columns = {name: _from_npy(data) for name, data in _attachments(stream, budget)}
        if header.spec.cameras:  # else nothing in the messages is needed
            shape = (header.frames, *header.spec.image_size, 3)
            pictures = foxglove.read_images(_messages(stream, header, budget), header.spec.cameras, shape)
            columns |= {IMAGES + camera: frames for camera, frames in pictures.items()}
        final = take_final(columns)
        ends = header.success, header.success_at_end
        episode = Episode(header.seed, columns, *ends, final, header.instruction, header.drawn)
        if len(episode) != header.frames:
            raise ValueError(f"its header counts {header.frames:,} frames, its columns {len(episode):,}")
        return header, episode


def read_header(path: Path, *, check_sums: bool = False) -> Header:
    """Read the header without the columns; check_sums: and check both checksums of the file.

    Raises `ManipError` naming the file.
    """
    with _explain(path), open(checks.open_regular(path), "rb") as stream:
        if check_sums:
            check_both_sums(stream)
        return _header(stream)


def episode_path(folder: Path, seed: int) -> Path:
    """Return the path of the journal of a seed."""
    return folder / f"episode-{seed:012d}.mcap"


def list_seeds(folder: Path) -> list[int]:
    """Return the seeds of the folder's finished episodes, in order; none where the folder does not exist."""
    return sorted(int(match[1]) for path in folder.glob("episode-*.mcap") if (match := _NAME.fullmatch(path.name)))


def list_episodes(folder: Path) -> list[Path]:
    """Return the folder's finished episodes in the order of their seeds; none where the folder does not exist."""
    return [episode_path(folder, seed) for seed in list_seeds(folder)]


def set_aside(path: Path) -> Path:
    """Rename a damaged file to `<name>.damaged`, so that its seed is free; return the new path."""
    return path.rename(path.with_name(path.name + _DAMAGED))


def clean_temporary(folder: Path) -> list[Path]:
    """Remove unfinished files of killed writers and return them. Only for when no writer is at work in `folder`."""
    leftovers = sorted(folder.glob(f".episode-*{PARTIAL}"))
    for path in leftovers:
        path.unlink(missing_ok=True)
    return leftovers


def encode_episode(episode: Episode, spec: RobotTaskSpec, fingerprint: dict[str, Any]) -> bytes:
    """Return a journal file's content; the same episode gives the same bytes.

    Raises `ManipError` for an episode that `read_episode` would refuse for its size.
    """
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile="", library=_RECORD)
    writer.add_metadata(_RECORD, {"format": _FORMAT} | Header.of(episode, spec, fingerprint).to_texts())
    channels, times = foxglove.episode_channels(episode, spec), foxglove.frame_times(episode, spec)
    foxglove.add_channels(writer, list(channels), times)
    for key, column in (episode.columns | final_columns(episode.final)).items():
        if key.startswith(IMAGES):
            continue  # pictures travel as messages, without loss as well
        writer.add_attachment(0, 0, key + _NPY, "application/octet-stream", _to_npy(episode.seed, key, column))
    writer.finish()
    _check_limits(stream, episode.seed)
    return stream.getvalue()


def _check_limits(stream: io.BytesIO, seed: int) -> None:
    """Raise `ManipError` where a journal is larger than what reading allows."""
    try:
        header, budget = _header(stream), _budget(stream)
        parts = [_attachments(stream, budget), _messages(stream, header, budget) if header.spec.cameras else ()]
        for _ in itertools.chain(*parts):
            pass
    except (ManipError, ValueError) as error:
        advice = "record shorter episodes, or smaller or fewer pictures"
        raise ManipError(f"the journal of the episode with seed {seed} could not be read: {error}; {advice}") from error


def _to_npy(seed: int, key: str, column: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    try:
        np.save(stream, column, allow_pickle=False)
    except ValueError as error:
        raise ManipError(f"episode with seed {seed}, column {key!r} of dtype {column.dtype}: {error}") from error
    return stream.getvalue()


def _from_npy(data: memoryview) -> NDArray[Any]:
    """The array in a file of numpy's format; `ValueError` where its header declares another size than it has."""
    head = io.BytesIO(data[:_LONGEST_NPY_HEADER])
    version = npy.read_magic(head)
    if version not in _NPY_HEADERS:
        raise ValueError(f"a column in numpy's format {version}; expected one of {list(_NPY_HEADERS)}")
    shape, is_fortran, dtype = _NPY_HEADERS[version](head)
    content = data[head.tell() :]
    if dtype.hasobject or not dtype.itemsize:
        raise ValueError(f"a column of {dtype}; expected numbers")
    if math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError(f"a column declares shape {checks.shorten(shape)} of {dtype} and has {len(content):,} bytes")
    return np.ndarray(shape, dtype, bytearray(content), order="F" if is_fortran else "C")


def _budget(stream: BinaryIO, times: int = 1) -> Budget:
    return Budget(stream.seek(0, os.SEEK_END), times * LARGEST_EPISODE, times * _LARGEST_RATIO)


def _attachments(stream: BinaryIO, budget: Budget) -> Iterator[tuple[str, memoryview]]:
    """Names and files of the columns, without those of pictures."""
    for count, record in enumerate(read_records(stream, Opcode.ATTACHMENT), start=1):
        if count > _MOST_COLUMNS:
            raise ValueError(f"it holds more than {_MOST_COLUMNS} columns")
        budget.take(len(record.body))
        name, data = to_attachment(record.body)
        yield name.removesuffix(_NPY), data


def _messages(stream: BinaryIO, header: Header, budget: Budget) -> Iterator[Record]:
    """Channels and messages, the pictures among them."""
    budget.take(len(header.spec.cameras) * header.frames * math.prod(header.spec.image_size) * 3)
    packed = _budget(stream, times=2)
    for chunk in read_records(stream, Opcode.CHUNK):
        yield from chunk_records(unpack(chunk, packed, check=False), packed)


def _header(stream: BinaryIO) -> Header:
    notes = [Metadata.read(ReadDataStream(io.BytesIO(record.body))) for record in read_records(stream, Opcode.METADATA)]
    ours = [note.metadata for note in notes if note.name == _RECORD]
    if len(ours) != 1:
        raise ValueError(f"it holds {len(ours)} metadata records {_RECORD!r}; expected one")
    data = ours[0]
    if (found := data.get("format")) != _FORMAT:
        if found == "1":
            raise OlderSchemaError("1", schema.VERSION)
        raise ValueError(f"its format is {checks.shorten(found)}; this version reads {_FORMAT!r}")
    return Header.from_texts(data)


@contextmanager
def _explain(path: Path) -> Generator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise ManipError(f"no such episode file: {path}") from error
    except OlderSchemaError as error:
        error.args = (f"{path}: {error}",)
        raise
    except Exception as error:  # a damaged file can make a parser raise anything
        why = str(error) or type(error).__name__
        raise ManipError(f"{path} is not a complete episode: {why}; --resume=true records it again") from error
