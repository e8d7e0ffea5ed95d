"""Open a dataset's video files, which may come from anyone: MP4 alone, of bounded pictures and a bounded index.

FFmpeg looks at what a file holds, not at its name: a playlist named `.mp4` makes it open other files and addresses.
And it keeps a file's index in memory, 36 bytes a frame, by counts that are only claims.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Iterator
from pathlib import Path

import av
from av.container import InputContainer

from manip_il.data.schema import MOST_PIXELS

MOST_INDEXED = 5_000_000  # frames of a file: 46 hours at 30 a second
_OPTIONS = {
    "protocol_whitelist": "file",
    "enable_drefs": "0",  # tracks that are in other files
    "max_pixels": str(2 * MOST_PIXELS),  # should pictures grow on the way; codecs round them up to whole blocks
}
_BOX = 8  # its size and name [bytes]
_MOST_BOXES = 100_000  # outermost ones
_COUNTS = re.compile(rb"(stsz|stz2|elst)(?s:.){4}")  # frames by their sizes, edits: version and flags, ..., count
_ELSEWHERE = re.compile(rb"moof|mvex|cmov")  # fragments and a packed index: what follows is counted nowhere here


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


def _check_index(path: Path) -> None:
    """Raise `ValueError` where FFmpeg would make a larger index of the file than any video needs."""
    if path.stat().st_size < _BOX:
        return  # FFmpeg says what it is
    frames, edits = 0, 1
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for start, stop in _outside_media(data):
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


def _outside_media(data: mmap.mmap) -> Iterator[tuple[int, int]]:
    """Where everything but coded frames lies: (start, stop) [bytes]."""
    at = 0
    for _ in range(_MOST_BOXES):
        if at + _BOX > len(data):
            return
        size, name = int.from_bytes(data[at : at + 4]), data[at + 4 : at + _BOX]
        if size == 1:  # it follows as 64 bits
            size = int.from_bytes(data[at + _BOX : at + 2 * _BOX])
        stop = min(at + size, len(data)) if size >= _BOX else len(data)
        if name != b"mdat" or size < _BOX:
            yield at, stop
        at = stop
    raise ValueError(f"it has more than {_MOST_BOXES:,} boxes")
