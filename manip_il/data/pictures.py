"""Read pictures of datasets, which may come from anyone: MP4 videos, PNG and JPEG, of bounded size.

FFmpeg looks at what a file holds, not at its name: a playlist named `.mp4` makes it open other files and addresses. It
keeps a file's index in memory, 36 bytes a frame, by counts that are only claims. Pillow hands other formats to other
programs (EPS to Ghostscript), and only warns of a picture that fills the memory.
"""

from __future__ import annotations

import itertools
import mmap
import re
import warnings
from collections.abc import Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
from av.container import InputContainer
from numpy.typing import NDArray
from PIL import Image

from manip_il import checks
from manip_il.data.schema import MOST_PIXELS
from manip_il.errors import ManipError

MOST_INDEXED = 5_000_000  # frames of a file: 46 hours at 30 a second
_OPTIONS = {
    "protocol_whitelist": "file",
    "enable_drefs": "0",  # tracks that are in other files
    "max_pixels": str(2 * MOST_PIXELS),  # should pictures grow on the way; codecs round them up to whole blocks
}
_BOX = 8  # its size and name [bytes]
MOST_BOXES = 100_000  # outermost ones
_COUNTS = re.compile(rb"(stsz|stz2|elst)(?s:.){4}")  # frames by their sizes, edits: version and flags, ..., count
_ELSEWHERE = re.compile(rb"moof|mvex|cmov")  # fragments and a packed index: what follows is counted nowhere here

_UNREADABLE = (av.FFmpegError, OSError, ValueError, OverflowError, IndexError)  # the last: there is no video stream
_FORMATS = ("PNG", "JPEG")
_LEVEL = 1  # of compression: the next ones save a tenth and take twice as long

Pictures = NDArray[np.uint8]  # (T, height, width, 3), RGB


def open_picture(content: bytes) -> Image.Image:
    """Open a PNG or JPEG, whose pixels are not decoded yet.

    Raises `ValueError` for another format, and for more than `MOST_PIXELS` pixels.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            picture = Image.open(BytesIO(content), formats=_FORMATS)
    except Image.UnidentifiedImageError as error:
        raise ValueError(f"it is not a {' or '.join(_FORMATS)}") from error
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise ValueError(f"it has more than {MOST_PIXELS:,} pixels") from error
    if picture.width * picture.height > MOST_PIXELS:
        raise ValueError(f"it has {picture.width} x {picture.height} pixels; expected at most {MOST_PIXELS:,} in all")
    return picture


def to_png(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture (height, width, 3) as the content of a PNG file."""
    stream = BytesIO()
    Image.fromarray(picture).save(stream, "PNG", compress_level=_LEVEL)
    return stream.getvalue()


def decode_cell(cell: Any) -> Pictures:
    """Return the picture (height, width, 3) in a cell of a data file, whose `path` is not followed.

    Raises `ValueError` as `decode_picture` does.
    """
    content = cast(dict[str, Any], cell).get("bytes") if isinstance(cell, dict) else None
    return decode_picture(content if isinstance(content, bytes) else None)


def decode_picture(content: bytes | None) -> Pictures:
    """Return the picture (height, width, 3) in the content of a file. Raises `ValueError` for none, or one not RGB."""
    if content is None:
        raise ValueError("a picture is not in the file")
    with open_picture(content) as picture:
        if picture.mode != "RGB":
            raise ValueError(f"a picture of mode {picture.mode}; expected RGB")
        return np.asarray(picture)


def open_video(path: Path) -> InputContainer:
    """Open an MP4 file for reading; its pictures are not decoded yet.

    Raises `ValueError` for an index or pictures beyond the limits, for a codec without a decoder, and for fragmented
    files, which no LeRobot dataset has; `OSError` and `av.FFmpegError` for what is no MP4 file or cannot be read.
    """
    _check_index(path)
    container = av.open(f"file:{path}", format="mp4", options=_OPTIONS)
    try:
        for stream in container.streams.video:
            if not stream.codec_context:  # PyAV's types do not say so
                raise ValueError("its pictures are of a codec that no decoder is known for; write it as AV1 or H.264")
            stream.codec_context.options = {"max_pixels": _OPTIONS["max_pixels"]}
            if stream.width * stream.height > MOST_PIXELS:
                size = f"{stream.width} x {stream.height}"
                raise ValueError(f"its pictures have {size} pixels; expected at most {MOST_PIXELS:,} in all")
    except BaseException:
        container.close()
        raise
    return container


class VideoReader:
    """Frames of video files, one file open at a time: opening a long one takes longer than decoding an episode."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._container: InputContainer | None = None

    def read(self, path: Path, first: int, count: int, fps: int) -> Pictures:
        """Decode frames `first` to `first + count - 1`, (count, height, width, 3).

        Raises `ManipError` for a file that cannot be read or does not hold each of them.
        """
        try:
            if self._container is None or self._path != path:
                self.close()
                self._container, self._path = open_video(path), path
            pictures = _decode(self._container, first, count, fps)
        except _UNREADABLE as error:
            raise _unreadable(path, error) from error
        if len(pictures) != count:
            raise ManipError(f"{path} has no frame {first + len(pictures)}; its dataset counts {count} from {first} on")
        return np.stack(pictures)

    def close(self) -> None:
        """Close the open file, if any."""
        if self._container is not None:
            self._container.close()
            self._path = self._container = None


def count_packets(path: Path) -> int:
    """Count the coded frames of a video file without decoding them. Raises `ManipError` for an unreadable one."""
    try:
        with closing(open_video(path)) as container:
            return sum(1 for packet in container.demux(container.streams.video[0]) if packet.size)
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error


def _check_index(path: Path) -> None:
    """Raise `ValueError` where FFmpeg would make a larger index of the file than any video needs."""
    if path.is_file() and path.stat().st_size < _BOX:
        return  # FFmpeg refuses it
    frames, edits = 0, 1
    with (
        open(checks.open_regular(path), "rb") as stream,
        mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        for name, size, start, stop in find_boxes(data):
            if name == b"mdat" and size >= _BOX:
                continue  # coded frames
            if found := _ELSEWHERE.search(data, start, stop):
                raise ValueError(
                    f"it has a box {found[0].decode()}, which videos of datasets do not have; write it as plain MP4"
                )
            for match in _COUNTS.finditer(data, start, stop):
                is_edits = match[1] == b"elst"
                at = match.end() + (0 if is_edits else 4)  # behind the size that all frames may have
                count = int.from_bytes(data[at : at + 4])
                frames, edits = (frames, max(edits, count)) if is_edits else (frames + count, edits)
    if frames * edits > MOST_INDEXED:
        raise ValueError(f"it declares {frames:,} frames and {edits:,} edits; expected at most {MOST_INDEXED:,} frames")


def find_boxes(data: mmap.mmap) -> Iterator[tuple[bytes, int, int, int]]:
    """Yield an MP4 file's outermost boxes: name, declared size, start and stop in the file [bytes].

    One of no valid size lasts to the end. Raises `ValueError` for too many.
    """
    at = 0
    for _ in range(MOST_BOXES):
        if at + _BOX > len(data):
            return
        size, name = int.from_bytes(data[at : at + 4]), data[at + 4 : at + _BOX]
        if size == 1:  # it follows as 64 bits
            size = int.from_bytes(data[at + _BOX : at + 2 * _BOX])
        stop = min(at + size, len(data)) if size >= _BOX else len(data)
        yield name, size, at, stop
        at = stop
    raise ValueError(f"it has more than {MOST_BOXES:,} boxes")


def _decode(container: InputContainer, first: int, count: int, fps: int) -> list[NDArray[np.uint8]]:
    """The frames as far as there is no gap."""
    stream = container.streams.video[0]
    tick = stream.time_base or 1  # [s]
    container.seek(round(first / fps / tick), stream=stream)  # to the key frame there or before
    pictures: list[NDArray[np.uint8]] = []
    for frame in itertools.islice(container.decode(stream), first + count):  # also where more claim to come before
        ahead = round((frame.pts or 0) * tick * fps) - first - len(pictures)
        if ahead == 0:
            pictures.append(frame.to_ndarray(format="rgb24").astype(np.uint8, copy=False))
            if pictures[-1].shape != pictures[0].shape:
                raise ValueError(f"its pictures change their size at frame {first + len(pictures) - 1}")
        if ahead > 0 or len(pictures) == count:
            break
    return pictures


def _unreadable(path: Path, error: Exception) -> ManipError:
    reason = "it holds no video" if isinstance(error, IndexError) else getattr(error, "strerror", None) or str(error)
    return ManipError(f"cannot read {path}: {reason}")
