"""The pictures of one camera of a LeRobot v3.0 dataset, in films or in the data files, decoded when they are read."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import av
import numpy as np
import PIL
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.episode_table import EpisodeTable
from manip_il.data.info import Feature, Info
from manip_il.data.parquet_files import UNREADABLE, integers, read_file
from manip_il.data.pictures import Pictures, VideoReader, decode_cell
from manip_il.errors import ManipError, MismatchError, UnknownName

I64 = NDArray[np.int64]
Rows = tuple[int, Pictures]  # pictures of consecutive frames, and the `index` of the first

_VERSION = 1  # of what is stored: another one makes all caches stale
_PART_BYTES = 32 * 1024 * 1024  # of pictures that are decoded at once
_PART_ROWS = 500  # of a data file, at least: opening one that has a row group an episode takes long
_LEAST = 32  # frames that are, however large: decoding starts at the last key frame before them
_OPEN_FILES = 32  # that one process holds open
_SEE_CHECK = "run `manip-il doctor` to see what is wrong"


@dataclass(frozen=True)
class VideoPart:
    """Frames `first` to `first + count - 1` of a video file, which are the dataset's from `row` on."""

    path: str
    first: int
    count: int
    row: int


@dataclass(frozen=True)
class ParquetPart:
    """The pictures of `count` frames from `row` on that row groups `first` to `last` of a data file hold."""

    path: str
    first: int
    last: int
    count: int
    row: int


Part = VideoPart | ParquetPart


@dataclass(frozen=True)
class Camera:
    """Pictures of one camera. size: height and width; parts: in the order of the frames, each of which they hold once.

    fingerprint: another one if anything changes that the pictures depend on.
    """

    root: Path
    key: str
    fps: float
    frames: int
    size: tuple[int, int]
    parts: tuple[Part, ...]
    fingerprint: str

    @classmethod
    def of(cls, root: Path, info: Info, episodes: EpisodeTable, data_files: Sequence[Path], key: str) -> Camera:
        """Find a camera's pictures without decoding any.

        Raises `UnknownName` for a column that is no camera, `ManipError` for a dataset without frames or whose files do
        not hold each frame once, and for depth maps.
        """
        cameras = {feature.key: feature for feature in info.of_dtype("video", "image")}
        if key not in cameras:
            raise UnknownName(f"camera in {root}", key, cameras)
        feature = cameras[key]
        if not feature.is_rgb:
            raise ManipError(f"{key} of {root} holds depth or has {feature.channels} channels; expected RGB pictures")
        if not info.frames:
            raise ManipError(f"{root} has no frames")
        films = feature.dtype == "video"
        parts = _films(episodes, info, key) if films else _row_groups(root, data_files)
        ends = [part.row + part.count for part in parts]
        if [0, *ends[:-1]] != [part.row for part in parts] or ends[-1:] != [info.frames]:
            raise ManipError(f"{root}: its files do not hold each of {info.frames} frames once; {_SEE_CHECK}")
        camera = cls(root, key, info.fps, info.frames, feature.picture_size, tuple(parts), "")
        return replace(camera, fingerprint=_fingerprint(camera, feature))

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of all its pictures, channels before pixels: (N, 3, height, width)."""
        return (self.frames, 3, *self.size)

    @property
    def nbytes(self) -> int:
        """Size of all its pictures as uint8 [bytes]."""
        return self.frames * 3 * self.size[0] * self.size[1]

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.frames

    def __getitem__(self, rows: I64) -> NDArray[np.uint8]:
        """Return the pictures of these rows (...), in any order, channels before pixels: (..., 3, height, width)."""
        read = np.ascontiguousarray(self.rows(rows.reshape(-1)).transpose(0, 3, 1, 2))
        return read.reshape(*rows.shape, *read.shape[1:])

    def rows(self, rows: I64) -> Pictures:
        """Return the pictures of these rows (B,), decoded, (B, height, width, 3).

        Raises `ManipError` for one that is not there, `MismatchError` for one of another size.
        """
        wanted, places = np.unique(rows, return_inverse=True)
        starts = np.array([part.row for part in self.parts])
        which = np.searchsorted(starts, wanted, side="right") - 1
        cuts = np.flatnonzero((np.diff(wanted) != 1) | (np.diff(which) != 0)) + 1
        found = [self._read(self.parts[which[at[0]]], wanted[at]) for at in np.split(np.arange(len(wanted)), cuts)]
        return np.concatenate(found)[places.reshape(-1)] if len(rows) else np.empty((0, *self.size, 3), np.uint8)

    def read(self, part: Part) -> Iterator[Rows]:
        """Yield a part's pictures, some at a time. Raises what `rows` raises."""
        step = max(_LEAST, _PART_BYTES * self.frames // self.nbytes)
        for start in range(part.row, part.row + part.count, step):
            rows = np.arange(start, min(start + step, part.row + part.count))
            yield start, self._read(part, rows)

    def _read(self, part: Part, rows: I64) -> Pictures:
        """Consecutive rows of one part."""
        path = self.root / part.path
        if isinstance(part, VideoPart):
            reader = _reader(path, self.fingerprint)
            pictures = reader.read(path, part.first + int(rows[0]) - part.row, len(rows), self.fps)
        else:
            cells = _cells(self.root, self.key, part, self.fingerprint)[rows[0] - part.row : rows[-1] + 1 - part.row]
            try:
                pictures = np.stack([decode_cell(cell) for cell in cells.to_pylist()])
            except UNREADABLE as error:
                place = f"frames {rows[0]} to {rows[-1]} of {path}"
                raise ManipError(
                    f"cannot read the pictures {self.key} in {place}: {checks.one_line(error)}; {_SEE_CHECK}"
                ) from error
        if pictures.shape[1:] != (*self.size, 3):
            there = f"{layout.INFO} of {self.root}"
            what, found = f"shape of {self.key}", pictures.shape[1:]
            raise MismatchError(what, f"frame {rows[0]}", found, there, (*self.size, 3))
        return pictures


@lru_cache(_OPEN_FILES)
def _reader(path: Path, fingerprint: str) -> VideoReader:
    """One file's reader; a changed file has another fingerprint, and with that another one."""
    return VideoReader()


@lru_cache(_OPEN_FILES)
def _cells(root: Path, key: str, part: ParquetPart, fingerprint: str) -> Any:
    """A part's pictures as they are stored."""
    try:
        with pq.ParquetFile(root / part.path) as file:
            table = file.read_row_groups(range(part.first, part.last + 1), [key], use_threads=False)
    except UNREADABLE as error:
        raise ManipError(
            f"cannot read the pictures {key} in {root / part.path}: {checks.one_line(error)}; {_SEE_CHECK}"
        ) from error
    return table.column(key)


def _fingerprint(camera: Camera, feature: Feature) -> str:
    """A digest of everything that the pictures depend on.

    Files count by size and time of change, not by content: reading all of them at every start would take about as
    long as what the cache saves, and a wrong guess (a copy with new times) costs a build, no wrong picture. Where the
    dataset stands is left out: it may be moved.
    """
    try:
        files = {path: (camera.root / path).stat() for path in sorted({part.path for part in camera.parts})}
    except OSError as error:
        raise ManipError(f"cannot read {error.filename}: {error.strerror}; {_SEE_CHECK}") from error
    content: dict[str, Any] = {
        "version": _VERSION,
        "decoder": ["av", av.__version__] if feature.dtype == "video" else ["pillow", PIL.__version__],
        "camera": [camera.key, feature.dtype, camera.fps, camera.shape],
        "parts": [list(vars(part).values()) for part in camera.parts],
        "files": [[path, stat.st_size, stat.st_mtime_ns] for path, stat in files.items()],
    }
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _films(episodes: EpisodeTable, info: Info, key: str) -> list[Part]:
    """Consecutive frames of a file that are consecutive frames of the dataset: mostly the whole file."""
    clips = episodes.clips[key]
    firsts = np.round(clips.starts * info.fps).astype(np.int64)
    found: list[Part] = []
    for place in np.argsort(episodes.start, kind="stable"):
        path, first, count, row = clips.files[place], *map(int, (firsts[place], *_span(episodes, place)))
        last = found[-1] if found else None
        if not count:
            continue
        if isinstance(last, VideoPart) and (path, first) == (last.path, last.first + last.count):
            found[-1] = replace(last, count=last.count + count)
        else:
            found.append(VideoPart(path, first, count, row))
    return found


def _span(episodes: EpisodeTable, place: int) -> tuple[int, int]:
    return int(episodes.length[place]), int(episodes.start[place])


def _row_groups(root: Path, data_files: Sequence[Path]) -> list[Part]:
    found: list[Part] = []
    for path in data_files:
        index, held = integers(read_file(path, [layout.INDEX]), layout.INDEX), pq.read_metadata(path)
        sizes = [held.row_group(group).num_rows for group in range(held.num_row_groups)]
        ends = np.cumsum(sizes)
        first, start = 0, 0
        for group, end in enumerate(ends.tolist()):
            if end - start >= _PART_ROWS or group == len(sizes) - 1:
                rows = index[start:end]
                if len(rows) and not np.array_equal(rows, np.arange(rows[0], rows[0] + len(rows))):
                    raise ManipError(f"{path}: its rows are not in the order of their `index`; {_SEE_CHECK}")
                found.append(ParquetPart(path.relative_to(root).as_posix(), first, group, end - start, int(rows[0])))
                first, start = group + 1, end
    return sorted(found, key=lambda part: part.row)
