"""Find a camera's pictures in a LeRobot v3.0 dataset, and a fingerprint that changes when they do."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import PIL
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.info import Feature, Info, read_info
from manip_il.data.parquet_files import UNREADABLE, Shard, find_shards, floats, integers
from manip_il.data.pictures import Pictures, VideoReader, decode_cell
from manip_il.errors import ManipError, MismatchError, UnknownName

Rows = tuple[int, Pictures]  # pictures of consecutive frames, and the `index` of the first

_VERSION = 1  # of what is stored: another one makes all caches stale
_PART_BYTES = 32 * 1024 * 1024  # of pictures that are decoded at once
_PART_ROWS = 500  # of a data file, at least: opening one that has a row group an episode takes long
_LEAST = 32  # frames that are, however large: decoding starts at the last key frame before them
_PLACES = ("length", "dataset_from_index")
_SEE_DOCTOR = "run `manip-il doctor` to see what is wrong"


@dataclass(frozen=True)
class VideoPart:
    """Frames `first` to `first + count - 1` of a video file, which are the dataset's from `row` on."""

    path: str
    first: int
    count: int
    row: int

    def read(self, root: Path, key: str, fps: int) -> Iterator[Rows]:
        """Decode them, all at once. Raises `ManipError` where one is not there."""
        with closing(VideoReader()) as reader:
            yield self.row, reader.read(root / self.path, self.first, self.count, fps)


@dataclass(frozen=True)
class ParquetPart:
    """The pictures that row groups `first` to `first + count - 1` of a data file hold."""

    path: str
    first: int
    count: int

    def read(self, root: Path, key: str, fps: int) -> Iterator[Rows]:
        """Decode them, one by one. Raises `ManipError` where one cannot be."""
        try:
            with pq.ParquetFile(root / self.path) as file:
                groups = range(self.first, self.first + self.count)
                for batch in file.iter_batches(64, groups, [key, layout.INDEX], use_threads=False):
                    rows, stored = (batch.column(name).to_pylist() for name in (layout.INDEX, key))
                    for row, picture in zip(rows, stored, strict=True):
                        yield row, decode_cell(picture)[None]
        except UNREADABLE as error:
            raise ManipError(f"cannot read the pictures {key} in {root / self.path}: {error}; {_SEE_DOCTOR}") from error


Part = VideoPart | ParquetPart


@dataclass(frozen=True)
class FrameSource:
    """One camera of a dataset. size: height and width; parts: they hold every frame once."""

    root: Path
    key: str
    fps: int
    frames: int
    size: tuple[int, int]
    parts: tuple[Part, ...]
    fingerprint: str

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of all its pictures, channels before pixels: (N, 3, height, width)."""
        return (self.frames, 3, *self.size)

    @property
    def nbytes(self) -> int:
        """Size of all its pictures as uint8 [bytes]."""
        return self.frames * 3 * self.size[0] * self.size[1]

    def read(self, part: Part) -> Iterator[Rows]:
        """Yield a part's pictures.

        Raises `ManipError` where one is missing, `MismatchError` where one has another size.
        """
        for row, pictures in part.read(self.root, self.key, self.fps):
            yield row, self.check_size(row, pictures)

    def check_size(self, row: int, pictures: Pictures) -> Pictures:
        """Return the pictures, of the frames from `row` on. Raises `MismatchError` unless they have the size."""
        if pictures.shape[1:] != (*self.size, 3):
            there = f"{layout.INFO} of {self.root}"
            raise MismatchError(f"shape of {self.key}", f"frame {row}", pictures.shape[1:], there, (*self.size, 3))
        return pictures


def find_frames(root: Path, key: str) -> FrameSource:
    """Find a camera's pictures without decoding any.

    Raises `ManipError` for a folder that is no dataset, one without frames, one whose files do not hold each frame
    once, and for depth maps; `UnknownName` for a column that is no camera.
    """
    info = read_info(root)
    cameras = {feature.key: feature for feature in info.of_dtype("video", "image")}
    if key not in cameras:
        raise UnknownName(f"camera in {root}", key, cameras)
    camera = cameras[key]
    if camera.channels != 3 or camera.details.get("is_depth_map"):
        raise ManipError(f"{key} of {root} holds depth or has {camera.channels} channels; expected RGB pictures")
    if not info.frames:
        raise ManipError(f"{root} has no frames")
    parts = _video_runs(root, info, key) if camera.dtype == "video" else _row_groups(root, info)
    source = FrameSource(root, key, int(info.fps), info.frames, camera.picture_size, tuple(parts), "")
    return replace(source, fingerprint=_fingerprint(source, camera), parts=tuple(_pieces(source)))


def _fingerprint(source: FrameSource, camera: Feature) -> str:
    """A digest of everything that the pictures depend on.

    Files count by size and time of change, not by content: reading all of them at every start would take about as
    long as what the cache saves, and a wrong guess (a copy with new times) costs a build, no wrong picture. Where the
    dataset stands is left out: it may be moved.
    """
    try:
        files = {path: (source.root / path).stat() for path in sorted({part.path for part in source.parts})}
    except OSError as error:
        raise ManipError(f"cannot read {error.filename}: {error.strerror}; {_SEE_DOCTOR}") from error
    content: dict[str, Any] = {
        "version": _VERSION,
        "decoder": ["av", av.__version__] if camera.dtype == "video" else ["pillow", PIL.__version__],
        "camera": [source.key, camera.dtype, source.fps, source.shape],
        "parts": [list(vars(part).values()) for part in source.parts],
        "files": [[path, stat.st_size, stat.st_mtime_ns] for path, stat in files.items()],
    }
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _video_runs(root: Path, info: Info, key: str) -> Iterator[VideoPart]:
    """Consecutive frames of a file that are consecutive frames of the dataset: mostly the whole file."""
    last: VideoPart | None = None
    expected = 0
    clips = find_clips(root, key, info.fps)
    clips = clips[clips[:, 0] != 0]
    for clip in clips[np.argsort(clips[:, 1], kind="stable")]:
        part = to_part(clip, key, info.video_path)
        if part.row != expected:
            raise ManipError(f"{root}: its episodes hold no frame {expected}, or hold it twice; {_SEE_DOCTOR}")
        expected += part.count
        if last is not None and (part.path, part.first) == (last.path, last.first + last.count):
            last = replace(last, count=last.count + part.count)
            continue
        if last is not None:
            yield last
        last = part
    if last is None or expected != info.frames:
        raise ManipError(f"{root}: {layout.INFO} counts {info.frames} frames, its episodes {expected}; {_SEE_DOCTOR}")
    yield last


def find_clips(root: Path, key: str, fps: float) -> NDArray[np.int64]:
    """Find every episode's frames of one camera, (E, 5): their number and first row, chunk, file, first frame in it.

    Raises `ManipError` for files that cannot be read.
    """
    names = [*_PLACES, *(f"videos/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp"))]
    found: list[NDArray[np.int64]] = [np.empty((0, 5), np.int64)]
    for shard in _whole_shards(root, layout.EPISODES_FILES):
        try:
            for table in shard.tables(names):
                first = np.round(floats(table, names[4]) * fps).astype(np.int64)
                found.append(np.stack([*(integers(table, name) for name in names[:4]), first], axis=1))
        except UNREADABLE as error:
            raise ManipError(f"cannot read {shard.path}: {error}; {_SEE_DOCTOR}") from error
    return np.concatenate(found)


def to_part(clip: NDArray[np.int64], key: str, video_path: str) -> VideoPart:
    """Return a row (5,) of `find_clips` as a part. video_path: the template of `info.json`."""
    count, row, chunk, file, first = map(int, clip)
    return VideoPart(video_path.format(video_key=key, chunk_index=chunk, file_index=file), first, count, row)


def _whole_shards(root: Path, pattern: str) -> Iterator[Shard]:
    for shard in find_shards(root, pattern):
        if shard.problem:
            raise ManipError(f"cannot read {shard.path}: it {shard.problem}; {_SEE_DOCTOR}")
        yield shard


def _row_groups(root: Path, info: Info) -> Iterator[ParquetPart]:
    rows: list[NDArray[np.int64]] = []
    for shard in _whole_shards(root, layout.DATA_FILES):
        try:
            rows += [integers(table, layout.INDEX) for table in shard.tables([layout.INDEX])]
            held = pq.read_metadata(shard.path)
        except UNREADABLE as error:
            raise ManipError(f"cannot read {shard.path}: {error}; {_SEE_DOCTOR}") from error
        first = pending = 0
        for group in range(held.num_row_groups):
            pending += held.row_group(group).num_rows
            if pending >= _PART_ROWS or group == held.num_row_groups - 1:
                yield ParquetPart(shard.name, first, group + 1 - first)
                first, pending = group + 1, 0
    if not rows or not np.array_equal(np.sort(np.concatenate(rows)), np.arange(info.frames)):
        raise ManipError(f"{root}: its data files do not hold each of {info.frames} frames once; {_SEE_DOCTOR}")


def _pieces(source: FrameSource) -> Iterator[Part]:
    """Parts that fit in memory. Row groups are read bit by bit as they are."""
    limit = max(_LEAST, _PART_BYTES * source.frames // source.nbytes)
    for part in source.parts:
        if isinstance(part, ParquetPart):
            yield part
            continue
        for start in range(0, part.count, limit):
            count = min(limit, part.count - start)
            yield VideoPart(part.path, part.first + start, count, part.row + start)
