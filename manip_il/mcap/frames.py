"""Pictures on their way through MCAP: out of a dataset frame by frame, and out of messages."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.lerobot_read import read_frames
from manip_il.data.parquet_limits import check_parquet
from manip_il.data.pictures import open_picture
from manip_il.errors import ManipError

U8 = NDArray[np.uint8]

_ROWS = 64  # of encoded pictures held at a time
_RAW = {"rgb8": slice(None), "bgr8": slice(None, None, -1)}  # encoding -> its channels as R, G, B
_COLOURS = ("RGB", "L", "P", "1")  # PIL's modes that RGB holds without loss


class DatasetFrames:
    """Pictures of one dataset, episodes taken in stored order. dtypes: camera column -> `image` or `video`."""

    def __init__(self, root: Path, dtypes: dict[str, str]):
        self._root = root
        self._stored = {key: _stored(root, key) for key, dtype in dtypes.items() if dtype == "image"}

    def read(self, key: str, episode: int, count: int) -> Iterator[U8]:
        """Return the episode's pictures (height, width, 3); all must be taken before the next episode's."""
        if key in self._stored:
            return itertools.islice(self._stored[key], count)
        return iter(read_frames(self._root, key, episode))


def is_depth(feature: dict[str, Any]) -> bool:
    """Return whether a picture column holds distances, and no colours."""
    info = feature.get("info") or {}
    return bool(info.get("is_depth_map") or info.get("video.is_depth_map"))


def decode_message(schema: str, message: Any) -> U8:
    """Return the picture (height, width, 3) of a `foxglove.RawImage` or `foxglove.CompressedImage`.

    Raises `ManipError` for another schema, encoding or a picture that is not whole.
    """
    is_picture = schema in ("foxglove.CompressedImage", "foxglove.RawImage")
    if not (is_picture and hasattr(message, "DESCRIPTOR")):  # JSON has no such thing
        raise ManipError(
            f"a message of {schema or 'no schema'}; pictures are read from foxglove.RawImage and "
            "foxglove.CompressedImage in protobuf"
        )
    return decode_bytes(message.data) if schema == "foxglove.CompressedImage" else _decode_raw(message)


def decode_bytes(data: bytes) -> U8:
    """Return a PNG or JPEG as RGB (height, width, 3). Raises `ManipError` for anything else."""
    try:
        with open_picture(data) as picture:
            if picture.mode not in _COLOURS:
                raise ManipError(f"a picture of mode {picture.mode}; expected 8-bit colours without transparency")
            return np.asarray(picture.convert("RGB"))
    except (OSError, ValueError, SyntaxError) as error:
        raise ManipError(f"a picture that cannot be decoded: {error}") from error


def _decode_raw(message: Any) -> U8:
    if message.encoding not in _RAW:
        raise ManipError(f"its pictures are encoded as {message.encoding!r}; expected {' or '.join(_RAW)}")
    height, width, step = message.height, message.width, message.step or message.width * 3
    if step < width * 3 or len(message.data) != height * step:
        raise ManipError(f"a picture of {height} x {width} with {len(message.data)} bytes, {step} a row")
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)
    return np.ascontiguousarray(rows[:, : width * 3].reshape(height, width, 3)[:, :, _RAW[message.encoding]])


def _stored(root: Path, key: str) -> Iterator[U8]:
    """Every picture of an `image` column, in stored order."""
    for path in sorted(root.glob(layout.DATA_FILES)):
        try:
            check_parquet([path], [key])
            for batch in pq.ParquetFile(path).iter_batches(_ROWS, columns=[key]):
                for cell in batch.column(0).to_pylist():
                    yield decode_bytes(cell["bytes"] or b"")
        except (OSError, ValueError, pa.ArrowException, ManipError) as error:
            raise ManipError(f"cannot read the pictures {key!r} in {path}: {error}") from error
