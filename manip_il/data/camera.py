"""The pictures of one camera of a LeRobot v3.0 dataset, in video or data files, decoded on reading.

All pictures of datasets are opened here, and only as MP4, PNG or JPEG. By default FFmpeg detects
the format from the content: a playlist named `.mp4` would make it open other files and URLs. Pillow
passes some formats to other programs (EPS to Ghostscript).
"""

import itertools
import math
import os
import tempfile
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from numpy.typing import NDArray
from PIL import Image

from manip_il import checks
from manip_il.data.atomic import writing
from manip_il.data.info import reading
from manip_il.data.parquet_files import read_file
from manip_il.mdp import I64

Pictures = NDArray[np.uint8]  # (T, height, width, 3), RGB

FORMATS = ("PNG", "JPEG")  # of pictures that are decoded
_PIECE_BYTES = 32 * 1024 * 1024  # size of the pictures that a thread decodes at once
# least number of pictures decoded at once, because each piece is decoded from the key frame before
# it
_PIECE = 32
_OPTIONS = {
    "protocol_whitelist": "file",
    "enable_drefs": "0",  # no tracks in other files
}
_BLOCK = 128  # largest block of pixels by which decoders enlarge pictures
_OPEN_FILMS, _OPEN_TABLES = 32, 4  # video and data files that one process keeps open


@dataclass(frozen=True)
class FrameRange:
    """Successive frames of a file, which belong to successive rows of the dataset.

    Attributes:
        path: The file.
        first: Index of the first frame in the file.
        count: Number of frames.
        row: The dataset's row of the first frame.
    """

    path: Path
    first: int
    count: int
    row: int


@dataclass(frozen=True)
class Camera:
    """Pictures of one camera.

    Attributes:
        key: The camera's column.
        fps: Rate of the pictures [Hz].
        size: Height and width [pixels].
        films: Whether pictures are in video files; otherwise they are cells of the data files.
        parts: Ranges that hold every row once, in order.
    """

    key: str
    fps: float
    size: tuple[int, int]
    films: bool
    parts: tuple[FrameRange, ...]

    @property
    def frames(self) -> int:
        """Number of pictures."""
        return sum(part.count for part in self.parts)

    def rows(self, rows: I64) -> Pictures:
        """Return the decoded pictures, (B, height, width, 3), of these rows, (B,).

        Raises `ManipError` if one is missing or has another size.
        """
        wanted, places = np.unique(rows, return_inverse=True)
        starts = np.array([part.row for part in self.parts])
        which = np.searchsorted(starts, wanted, side="right") - 1
        cuts = np.flatnonzero((np.diff(wanted) != 1) | (np.diff(which) != 0)) + 1
        found = [
            self._read(self.parts[which[at[0]]], wanted[at])
            for at in np.split(np.arange(len(wanted)), cuts)
        ]
        return np.concatenate(found)[places.reshape(-1)]

    def _read(self, part: FrameRange, rows: I64) -> Pictures:
        """Return the pictures of consecutive rows of one part."""
        first = part.first + int(rows[0]) - part.row
        with reading(part.path):
            changed = part.path.stat().st_mtime_ns
            if self.films:
                film = _film(part.path, changed, threading.get_ident(), self.size)
                pictures = read_frames(film, first, len(rows), self.fps)
            else:
                cells = _table(part.path, changed, self.key)[first : first + len(rows)]
                # a cell's `path` is never followed
                contents = [(cell or {}).get("bytes") for cell in cells.to_pylist()]
                pictures = np.stack([decode_picture(content, self.size) for content in contents])
            check_size(pictures.shape[1:3], self.size)
        return pictures


def decode(
    cameras: Sequence[Camera], on_frames: Callable[[int], None] | None = None
) -> NDArray[np.uint8]:
    """Decode all pictures of some cameras, with one thread per core.

    Args:
        cameras: The cameras, whose pictures all have the same size.
        on_frames: Called with the number of frames decoded since the last call.

    Returns:
        The pictures, channels first, (N, 3, height, width): a memory map of an unnamed temporary
        file, which is deleted with it.

    Raises:
        ManipError: if the disk is full.
    """
    shape = sum(camera.frames for camera in cameras), 3, *cameras[0].size
    with writing(Path(tempfile.gettempdir())), tempfile.TemporaryFile() as file:
        # otherwise a full disk kills the process
        os.posix_fallocate(file.fileno(), 0, math.prod(shape))
        decoded = np.memmap(file, np.uint8, "r+", shape=shape)
    step = max(_PIECE, _PIECE_BYTES // math.prod(shape[1:]))
    pieces = list[tuple[Camera, I64, NDArray[np.uint8]]]()  # camera, rows, place of their pictures
    start = 0
    for camera in cameras:
        for rows in np.split(np.arange(camera.frames), range(step, camera.frames, step)):
            pieces.append((camera, rows, decoded[start : start + len(rows)]))
            start += len(rows)

    def fill(piece: tuple[Camera, I64, NDArray[np.uint8]]) -> int:
        camera, rows, place = piece
        place[:] = camera.rows(rows).transpose(0, 3, 1, 2)
        return len(rows)

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as threads:
        for count in threads.map(fill, pieces):
            if on_frames is not None:
                on_frames(count)
    return decoded


def check_size(found: tuple[int, ...], size: tuple[int, int] | None) -> None:
    """Raise `ValueError` unless a picture's height and width are those in `info.json`, if these
    are given.
    """
    if size is not None and found != size:
        raise ValueError(
            f"its pictures are {found[0]} x {found[1]}; expected {size[0]} x {size[1]}, as in"
            " info.json"
        )


def open_picture(
    content: bytes | None, size: tuple[int, int] | None = None, formats: tuple[str, ...] = FORMATS
) -> Image.Image:
    """Open a picture file's content without decoding it.

    Args:
        content: The file's content.
        size: The expected height and width [pixels].
        formats: Pillow's names of the allowed formats.

    Raises:
        ValueError, OSError: The content is None or has another format or size.
    """
    picture = Image.open(BytesIO(content or b""), formats=formats)
    check_size((picture.height, picture.width), size)
    return picture


def decode_picture(content: bytes | None, size: tuple[int, int] | None = None) -> Pictures:
    """Decode a PNG or JPEG file's content to a picture (height, width, 3).

    Raises what `open_picture` raises, and `ValueError` for another colour mode.
    """
    with open_picture(content, size) as picture:
        if picture.mode != "RGB":
            raise ValueError(f"the picture has colour mode {picture.mode}; expected RGB")
        return np.asarray(picture)


def open_video(path: Path, size: tuple[int, int] | None = None) -> InputContainer:
    """Open an MP4 file for reading, without decoding.

    Args:
        path: The file.
        size: The expected height and width of the pictures [pixels].

    Raises:
        ManipError: It is not a regular file.
        av.FFmpegError: It is not an MP4 file.
        ValueError: Its pictures have another size.
    """
    with checks.native_path(path, "an MP4 file") as opened:
        container = av.open(f"file:{opened}", format="mp4", options=_OPTIONS)
    for stream in container.streams.video:
        check_size((stream.height, stream.width), size)
        # sizes may also change within the stream
        most = (stream.height + _BLOCK) * (stream.width + _BLOCK)
        stream.codec_context.options = {"max_pixels": str(most)}
    return container


def read_frames(container: InputContainer, first: int, count: int, fps: float) -> Pictures:
    """Decode successive frames of an open video.

    Args:
        container: The video.
        first: Index of the first frame.
        count: Number of frames.
        fps: Rate of the video [frames/s].

    Returns:
        The pictures, (count, height, width, 3).

    Raises:
        ValueError: if a frame is missing.
        av.FFmpegError: if the video cannot be decoded.
    """
    stream = container.streams.video[0]
    tick = stream.time_base or 1  # [s]
    # to the last key frame at or before it
    container.seek(round(first / fps / tick), stream=stream)
    pictures: list[Any] = []
    # bounded even if the file is malicious
    for frame in itertools.islice(container.decode(stream), first + count):
        ahead = round((frame.pts or 0) * tick * fps) - first - len(pictures)
        if ahead == 0:
            pictures.append(frame.to_ndarray(format="rgb24"))
        if ahead > 0 or len(pictures) == count:
            break
    if len(pictures) != count:
        raise ValueError(
            f"it has no frame {first + len(pictures)}; expected frames {first} to"
            f" {first + count - 1}"
        )
    return np.stack(pictures)


@lru_cache(_OPEN_FILMS)
def _film(path: Path, changed: int, thread: int, size: tuple[int, int]) -> InputContainer:
    """Open a video, cached by file, its time of change and thread: opening takes longer than
    decoding an episode.
    """
    return open_video(path, size)


@lru_cache(_OPEN_TABLES)
def _table(path: Path, changed: int, key: str) -> Any:
    """Return a data file's column of pictures, not decoded."""
    return read_file(path, [key]).column(key)
