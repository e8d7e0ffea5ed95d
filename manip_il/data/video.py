"""Encode pictures with LeRobot's settings; every episode is appended to a file that stays open.

LeRobot writes one file per episode and then copies all earlier episodes into a new file. Its
settings are copied here (and tests compare the two), because importing `lerobot.configs.video`
imports torch, which takes seconds.
"""

import os
import shutil
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.camera import Pictures
from manip_il.data.dataset import EpisodeData
from manip_il.data.schema import exact_rate
from manip_il.data.video_config import VideoConfig
from manip_il.errors import UsageError

# bitexact omits the muxer's version; faststart puts the index at the beginning
_OPTIONS = {"movflags": "faststart", "fflags": "+bitexact"}


class CameraFiles:
    """Writes one camera's numbered video files, one at a time.

    The same episodes give the same bytes.

    Args:
        folder: Folder of the dataset.
        key: The camera's key in the dataset, such as `observation.images.front`.
        config: Settings of the encoder.
        fps: Rate of the videos [frames/s].

    Attributes:
        size: Height and width of the written pictures [pixels]; None if videos were only copied.
    """

    def __init__(self, folder: Path, key: str, config: VideoConfig, fps: float):
        self._folder = folder
        self._key = key
        self._config = config
        self._fps = fps
        self._rate = exact_rate(fps)
        self._number = 0  # of the open or the next file
        self._frames = 0  # in the open file
        self._bytes = 0
        self._container: Any = None  # the open file
        self._stream: Any = None
        self._copied: dict[Path, dict[str, Any]] = {}  # source -> its place in the new dataset
        self.size: tuple[int, int] | None = None

    def copy(self, episode: EpisodeData) -> dict[str, Any]:
        """Copy the whole video file that holds an episode, unless already copied.

        Return the columns of its row.
        """
        film = episode.films[self._key]
        if film.path not in self._copied:
            self.close()
            path, self._copied[film.path] = self._next_file()
            with checks.native_path(film.path, "an MP4 file") as opened:
                shutil.copyfile(opened, path)
            self._number += 1
        return self._copied[film.path] | self._times(film.first, film.count)

    def write(self, frames: Pictures) -> dict[str, Any]:
        """Append the frames of an episode; return the columns of its row.

        Raises `UsageError` if the encoder refuses its settings, and `av.FFmpegError` if the frames
        cannot be written.
        """
        if self._bytes >= layout.VIDEO_FILES_SIZE_IN_MB * 2**20:
            self.close()
        path, place = self._next_file()
        self.size = size = frames.shape[1], frames.shape[2]
        encoder: Any
        if self._container is None:
            self._container = av.open(str(path), "w", options=_OPTIONS)
            self._stream = self._container.add_stream(self._config.vcodec, self._rate)
            encoder = self._stream.codec_context
        else:  # a new encoder, so that its bytes do not depend on other episodes
            encoder = av.CodecContext.create(self._config.vcodec, "w")
        _open(encoder, self._config, size, self._rate)
        times = self._times(self._frames, len(frames))
        for picture in frames:
            self._mux(encoder.encode(_video_frame(picture, self._frames, self._rate)))
            self._frames += 1
        self._mux(encoder.encode(None))
        return place | times

    def close(self) -> None:
        """Finish the open file, if any. Raises `OSError` if it cannot be written."""
        container = self._container
        self._container = None  # first, so that an error on closing is raised once
        if container is not None:
            self._number += 1
            self._frames = 0
            self._bytes = 0
            container.close()

    def info(self, size: tuple[int, int]) -> dict[str, Any]:
        """Return the entry of LeRobot's `info.json` for this camera.

        Args:
            size: Height and width of the pictures [pixels].
        """
        config = self._config
        return {
            "video.height": size[0],
            "video.width": size[1],
            "video.codec": av.Codec(config.vcodec, "w").canonical_name,
            "video.pix_fmt": config.pix_fmt,
            "video.fps": self._fps,
            "video.channels": 3,
            "has_audio": False,
            "video.g": config.g,
            "video.crf": config.crf,
            "video.preset": config.preset,
            "video.fast_decode": 0,
            "video.video_backend": "pyav",
            "video.extra_options": {},
            "is_depth_map": False,
        }

    def _next_file(self) -> tuple[Path, dict[str, Any]]:
        """Return the path of the open or the next file, and its numbers in columns of
        `meta/episodes`.
        """
        name, chunk, file = layout.numbered(layout.VIDEO_PATH, self._number, video_key=self._key)
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path, {
            f"videos/{self._key}/chunk_index": chunk,
            f"videos/{self._key}/file_index": file,
        }

    def _times(self, first: int, count: int) -> dict[str, Any]:
        return {
            f"videos/{self._key}/from_timestamp": first / self._fps,
            f"videos/{self._key}/to_timestamp": (first + count) / self._fps,
        }

    def _mux(self, packets: list[Any]) -> None:
        for packet in packets:
            packet.stream = self._stream
            self._bytes += packet.size
            self._container.mux_one(packet)


def _open(encoder: Any, config: VideoConfig, size: tuple[int, int], rate: Fraction) -> None:
    """Open an encoder. Raises `UsageError` if it refuses its settings.

    If run by root, SVT-AV1 permanently gives real-time priority (SCHED_FIFO) to the calling thread
    and to its worker threads, which with their child processes would starve all other processes.
    This undoes it.
    """
    # errors only; otherwise it prints its version for every encoder
    os.environ.setdefault("SVT_LOG", "1")
    encoder.options = config.options()
    encoder.height, encoder.width = size
    encoder.framerate = rate
    encoder.time_base = 1 / rate
    try:
        encoder.pix_fmt = config.pix_fmt
        encoder.open()
    except (av.FFmpegError, ValueError) as error:
        expected = f"expected even sizes and settings of {config.vcodec}"
        raise UsageError(
            f"cannot encode {size[1]} x {size[0]} pictures with {config}: {error}; {expected}"
        ) from error
    if os.geteuid() == 0 and encoder.name == "libsvtav1":
        for thread in map(int, os.listdir("/proc/self/task")):
            with suppress(OSError):  # the thread has ended
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


def _video_frame(picture: NDArray[np.uint8], number: int, rate: Fraction) -> av.VideoFrame:
    frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
    frame.pts, frame.time_base = number, 1 / rate
    return frame
