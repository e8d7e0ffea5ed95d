"""Read pictures of datasets: MP4 videos, PNG and JPEG. Nothing else opens a picture of a dataset.

FFmpeg looks at what a file holds, not at its name: a playlist named `.mp4` makes it open other files and addresses.
Pillow hands other formats to other programs (EPS to Ghostscript).
"""

from __future__ import annotations

import itertools
from io import BytesIO
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
from av.container import InputContainer
from numpy.typing import NDArray
from PIL import Image

from manip_il import checks
from manip_il.errors import ManipError

_OPTIONS = {
    "protocol_whitelist": "file",
    "enable_drefs": "0",  # tracks that are in other files
}
UNREADABLE = (av.FFmpegError, OSError, ValueError, OverflowError, IndexError)  # the last: there is no video stream
_FORMATS = ("PNG", "JPEG")
_LEVEL = 1  # of compression: the next ones save a tenth and take twice as long

Pictures = NDArray[np.uint8]  # (T, height, width, 3), RGB


def open_picture(content: bytes) -> Image.Image:
    """Open a PNG or JPEG, whose pixels are not decoded yet. Raises `ValueError` for another format."""
    try:
        return Image.open(BytesIO(content), formats=_FORMATS)
    except (Image.UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise ValueError(f"it is not a {' or '.join(_FORMATS)} of ordinary size") from error


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

    Raises `ValueError` for a codec without a decoder, `OSError` and `av.FFmpegError` for what is no MP4 file or cannot
    be read.
    """
    with open(checks.open_regular(path), "rb") as file:
        if file.read(8)[4:] != b"ftyp":
            raise ValueError("it does not begin as an MP4 file does; FFmpeg would take it for another format")
    container = av.open(f"file:{path}", format="mp4", options=_OPTIONS)
    if not all(stream.codec_context for stream in container.streams.video):  # PyAV's types do not say so
        container.close()
        raise ValueError("its pictures are of a codec that no decoder is known for; write it as AV1 or H.264")
    return container


def read_frames(path: Path, container: InputContainer, first: int, count: int, fps: float) -> Pictures:
    """Decode frames `first` to `first + count - 1` of an open video, (count, height, width, 3).

    Raises `ManipError` for a file that cannot be read or does not hold each of them.
    """
    try:
        pictures = _decode(container, first, count, fps)
    except UNREADABLE as error:
        raise unreadable(path, error) from error
    if len(pictures) != count:
        raise ManipError(f"{path} has no frame {first + len(pictures)}; its dataset counts {count} from {first} on")
    return np.stack(pictures)


def _decode(container: InputContainer, first: int, count: int, fps: float) -> list[NDArray[np.uint8]]:
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


def unreadable(path: Path, error: Exception) -> ManipError:
    """Return the error of a video that cannot be read."""
    reason = "it holds no video" if isinstance(error, IndexError) else getattr(error, "strerror", None) or str(error)
    return ManipError(f"cannot read {path}: {reason}")
