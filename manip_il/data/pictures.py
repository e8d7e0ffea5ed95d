"""Read pictures of datasets: MP4 videos, PNG and JPEG. Nothing else opens a picture of a dataset.

FFmpeg looks at what a file holds, not at its name: a playlist named `.mp4` makes it open other files and addresses.
Pillow hands other formats to other programs (EPS to Ghostscript).
"""

from __future__ import annotations

import itertools
from io import BytesIO
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from numpy.typing import NDArray
from PIL import Image

_OPTIONS = {
    "protocol_whitelist": "file",
    "enable_drefs": "0",  # tracks that are in other files
}
_FORMATS = ("PNG", "JPEG")
_LEVEL = 1  # of compression: the next ones save a tenth and take twice as long

Pictures = NDArray[np.uint8]  # (T, height, width, 3), RGB


def to_png(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture (height, width, 3) as the content of a PNG file."""
    stream = BytesIO()
    Image.fromarray(picture).save(stream, "PNG", compress_level=_LEVEL)
    return stream.getvalue()


def decode_picture(content: bytes | None) -> Pictures:
    """Return the picture (height, width, 3) in the content of a PNG or JPEG file.

    Raises `ValueError` for another format, one that is not RGB, or None.
    """
    if content is None:
        raise ValueError("a picture is not in the file")
    try:
        with Image.open(BytesIO(content), formats=_FORMATS) as picture:
            if picture.mode != "RGB":
                raise ValueError(f"a picture of mode {picture.mode}; expected RGB")
            return np.asarray(picture)
    except (Image.UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise ValueError(f"it is not a {' or '.join(_FORMATS)} of ordinary size") from error


def open_video(path: Path) -> InputContainer:
    """Open an MP4 file for reading; its pictures are not decoded yet.

    Raises `ValueError` for a codec without a decoder, `OSError` and `av.FFmpegError` for what is no MP4 file or cannot
    be read.
    """
    with path.open("rb") as file:
        if file.read(8)[4:] != b"ftyp":
            raise ValueError("it does not begin as an MP4 file does; FFmpeg would take it for another format")
    container = av.open(f"file:{path}", format="mp4", options=_OPTIONS)
    if not all(stream.codec_context for stream in container.streams.video):  # PyAV's types do not say so
        container.close()
        raise ValueError("its pictures are of a codec that no decoder is known for; write it as AV1 or H.264")
    return container


def read_frames(container: InputContainer, first: int, count: int, fps: float) -> Pictures:
    """Decode frames `first` to `first + count - 1` of an open video, (count, height, width, 3).

    Raises `ValueError` if it does not hold each of them, and what the decoder raises.
    """
    if not container.streams.video:
        raise ValueError("it holds no video")
    stream = container.streams.video[0]
    tick = stream.time_base or 1  # [s]
    container.seek(round(first / fps / tick), stream=stream)  # to the key frame there or before
    pictures: list[NDArray[np.uint8]] = []
    for frame in itertools.islice(container.decode(stream), first + count):  # also where more claim to come before
        ahead = round((frame.pts or 0) * tick * fps) - first - len(pictures)
        if ahead == 0:
            pictures.append(frame.to_ndarray(format="rgb24").astype(np.uint8, copy=False))
        if ahead > 0 or len(pictures) == count:
            break
    if len(pictures) != count:
        raise ValueError(f"it has no frame {first + len(pictures)}; its dataset counts {count} from {first} on")
    return np.stack(pictures)
