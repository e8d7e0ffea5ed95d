"""Decode video files: frames by their number, counted and checked."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.video_open import open_video
from manip_il.errors import ManipError, UsageError

_UNREADABLE = (av.FFmpegError, OSError, ValueError, OverflowError, IndexError)  # the last: there is no video stream


class VideoReader:
    """Frames of video files, one file open at a time: opening a long one takes longer than decoding an episode."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._container: InputContainer | None = None

    def read(self, path: Path, first: int, count: int, fps: int) -> NDArray[np.uint8]:
        """Decode frames `first` to `first + count - 1`, (count, height, width, 3).

        Raises `ManipError` for a file that cannot be read or does not hold each of them.
        """
        try:
            pictures = _decode(self._opened(path), first, count, fps)
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

    def _opened(self, path: Path) -> InputContainer:
        if self._container is None or self._path != path:
            self.close()
            self._container, self._path = open_video(path), path
        return self._container


class DatasetPictures:
    """Frames of a dataset's cameras by episode. columns: those of `meta/episodes` that say where they are."""

    def __init__(self, root: Path, fps: int, columns: Mapping[str, list[Any]]):
        self._root, self._fps, self._columns = root, fps, columns
        self._readers: dict[str, VideoReader] = {}

    @property
    def lengths(self) -> list[int]:
        """Frames of every episode."""
        return self._columns["length"]

    def place(self, key: str, episode: int) -> tuple[Path, int]:
        """Return the file that holds an episode's frames, and the number of the first one in it."""
        if not 0 <= episode < len(self.lengths):
            raise UsageError(f"{self._root} has no episode {episode}; it has 0 to {len(self.lengths) - 1}")
        chunk, file, start, _ = (self._columns[f"videos/{key}/{name}"][episode] for name in layout.VIDEO_COLUMNS)
        name = layout.VIDEO_PATH.format(video_key=key, chunk_index=chunk, file_index=file)
        return self._root / name, round(start * self._fps)

    def read(self, key: str, episode: int) -> NDArray[np.uint8]:
        """Decode one camera's frames of one episode, (T, height, width, 3)."""
        path, first = self.place(key, episode)
        return self._readers.setdefault(key, VideoReader()).read(path, first, self.lengths[episode], self._fps)

    def close(self) -> None:
        """Close the open files."""
        for reader in self._readers.values():
            reader.close()


def count_frames(path: Path) -> int:
    """Decode a whole video file and count its frames. Raises `ManipError` for one that cannot be decoded."""
    try:
        with closing(open_video(path)) as container:
            return sum(1 for _ in container.decode(container.streams.video[0]))
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error


def count_packets(path: Path) -> int:
    """Count the coded frames of a video file without decoding them. Raises `ManipError` for an unreadable one."""
    try:
        with closing(open_video(path)) as container:
            return sum(1 for packet in container.demux(container.streams.video[0]) if packet.size)
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error


def _decode(container: InputContainer, first: int, count: int, fps: int) -> list[NDArray[np.uint8]]:
    """As many of the frames as there are without a gap."""
    stream = container.streams.video[0]
    tick = stream.time_base or 1  # [s]
    container.seek(round(first / fps / tick), stream=stream)  # to the key frame there or before
    pictures: list[NDArray[np.uint8]] = []
    for frame in itertools.islice(container.decode(stream), first + count):  # however many say that they come before
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
