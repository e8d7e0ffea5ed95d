"""Encode pictures with LeRobot's settings; every episode is appended to a file that stays open.

LeRobot writes one file per episode and then copies all earlier episodes into a new file. Its settings are copied here
(and tests compare the two), because importing `lerobot.configs.video` imports torch, which takes seconds.
"""

from __future__ import annotations

import itertools
import os
import shutil
from contextlib import closing, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import av
import av.logging
import numpy as np
from av.container import OutputContainer
from av.packet import Packet
from av.video.codeccontext import VideoCodecContext
from av.video.stream import VideoStream
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.camera import Pictures, open_video
from manip_il.data.dataset import Dataset, StoredEpisode
from manip_il.data.info import reading
from manip_il.data.schema import exact_rate
from manip_il.data.video_config import VideoConfig
from manip_il.errors import UsageError
from manip_il.worlds.contract import plain_rate

# bitexact omits the muxer's version; faststart puts the index at the beginning
_OPTIONS = {"movflags": "faststart", "fflags": "+bitexact"}


@dataclass(frozen=True)
class VideoSpan:
    """One camera's frames of one episode: `frames` frames of a video file, from frame number `first`."""

    chunk: int
    file: int
    first: int
    frames: int


class CameraFiles:
    """Writes one camera's numbered video files, one at a time; the same episodes give the same bytes."""

    def __init__(self, folder: Path, key: str, config: VideoConfig, fps: float):
        self._folder = folder
        self._key = key
        self._config = config
        self._fps = exact_rate(fps)
        self._limit = layout.VIDEO_FILES_SIZE_IN_MB * 2**20
        self._number = self._frames = self._bytes = 0
        self.encodes = False  # whether pictures were written, not only copied
        self._container: OutputContainer | None = None
        self._stream: VideoStream | None = None
        self._copied: dict[tuple[Dataset, Path], tuple[int, int]] = {}  # chunk and file index

    def copy(self, episode: StoredEpisode, *, cut: bool = False) -> VideoSpan:
        """Copy the video file that holds an episode, unless already copied; return the episode's place in it.

        cut: copy only the episode's frames, to a file of their own.
        """
        source, first, frames = episode.clips[self._key]
        if cut or (episode.dataset, source) not in self._copied:
            self.close()
            name, chunk, file = layout.numbered(layout.VIDEO_PATH, self._number, video_key=self._key)
            (self._folder / name).parent.mkdir(parents=True, exist_ok=True)
            if cut:
                _cut(source, self._folder / name, first, frames, episode.dataset.fps)
            else:
                with checks.native_path(source, "an MP4 file") as opened:
                    shutil.copyfile(opened, self._folder / name)
            self._copied[episode.dataset, source] = chunk, file
            self._number += 1
        return VideoSpan(*self._copied[episode.dataset, source], 0 if cut else first, frames)

    def write(self, frames: Pictures) -> VideoSpan:
        """Append the frames of an episode. Raises `av.FFmpegError` if they cannot be encoded or written."""
        if self._bytes >= self._limit:
            self.close()
        name, chunk, number = layout.numbered(layout.VIDEO_PATH, self._number, video_key=self._key)
        size = frames.shape[1], frames.shape[2]
        if self._stream is None:
            encoder = self._open(self._folder / name, size)
        else:  # a new encoder, so that its bytes do not depend on other episodes
            encoder = _new_encoder(self._config, size, self._fps)
        clip = VideoSpan(chunk, number, self._frames, len(frames))
        for picture in frames:
            self._mux(_encode(encoder, _video_frame(picture, self._frames, self._fps)))
            self._frames += 1
        self._mux(_encode(encoder, None))
        return clip

    def close(self) -> None:
        """Finish the open file, if any. Raises `OSError` if it cannot be written."""
        # an error on closing is raised once
        container = self._container
        self._container = None
        self._stream = None
        if container is not None:
            self._number = self._number + 1
            self._frames = 0
            self._bytes = 0
            container.close()

    def info(self) -> dict[str, Any]:
        """Return the entry of LeRobot's `info.json` for this camera; its first file must be closed."""
        path, config = self._folder / layout.numbered(layout.VIDEO_PATH, 0, video_key=self._key)[0], self._config
        with closing(open_video(path)) as container:
            stream = container.streams.video[0]
            found = {
                "video.height": stream.height,
                "video.width": stream.width,
                "video.codec": stream.codec.canonical_name,
                "video.pix_fmt": stream.pix_fmt,
                "video.fps": plain_rate(float(stream.base_rate or 0)),
                "video.channels": len(stream.format.components),
                "has_audio": False,
            }
        settings = {"video.g": config.g, "video.crf": config.crf, "video.preset": config.preset, "video.fast_decode": 0}
        return {**found, **settings, "video.video_backend": "pyav", "video.extra_options": {}, "is_depth_map": False}

    def _open(self, path: Path, size: tuple[int, int]) -> VideoCodecContext:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.encodes, self._container = True, av.open(str(path), "w", options=_OPTIONS)
        options = self._config.options()
        self._stream = cast(VideoStream, self._container.add_stream(self._config.vcodec, self._fps, options=options))
        _set_up(self._stream.codec_context, self._config, size, self._fps)
        return self._stream.codec_context

    def _mux(self, packets: list[Packet]) -> None:
        for packet in packets:
            packet.stream = cast(VideoStream, self._stream)
            self._bytes += packet.size
            cast(OutputContainer, self._container).mux_one(packet)


def _cut(source: Path, target: Path, first: int, count: int, fps: float) -> None:
    """Copy `count` frames of a video file as they are encoded. Raises `ManipError` if they need frames before them."""
    with reading(source), closing(open_video(source)) as film, av.open(str(target), "w", options=_OPTIONS) as container:
        stream = film.streams.video[0]
        own, rate = (
            container.add_stream_from_template(stream, opaque=True),
            fps * float(stream.time_base or 1),
        )  # [frames/tick]
        film.seek(round(first / rate), stream=stream)  # to the last key frame at or before it
        inside = (one for one in film.demux(stream) if one.size and 0 <= round((one.pts or 0) * rate) - first < count)
        packets = list(itertools.islice(inside, count))
        if len(packets) != count or not packets[0].is_keyframe:
            raise ValueError(f"frames {first} to {first + count - 1} cannot be cut out without encoding them again")
        start = packets[0].pts or 0
        for one in packets:
            one.pts = (one.pts or 0) - start
            one.dts = (one.dts or 0) - start
            one.stream = own
            container.mux_one(one)


def _encode(encoder: VideoCodecContext, frame: av.VideoFrame | None) -> list[Packet]:
    """Encode a frame, or None to flush; the first one opens the encoder.

    If run by root, SVT-AV1 permanently gives real-time priority (SCHED_FIFO) to the calling thread and to its worker
    threads, which with their child processes would starve all other processes. This undoes it.
    """
    opens = not encoder.is_open
    packets = encoder.encode(frame)
    if opens and os.geteuid() == 0 and encoder.name == "libsvtav1":
        for thread in map(int, os.listdir("/proc/self/task")):
            with suppress(OSError):  # the thread has ended
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
    return packets


def _new_encoder(config: VideoConfig, size: tuple[int, int], fps: Fraction) -> VideoCodecContext:
    encoder = cast(VideoCodecContext, av.CodecContext.create(config.vcodec, "w"))
    encoder.options = config.options()
    _set_up(encoder, config, size, fps)
    return encoder


def _set_up(encoder: VideoCodecContext, config: VideoConfig, size: tuple[int, int], fps: Fraction) -> None:
    os.environ.setdefault("SVT_LOG", "1")  # errors only; otherwise it prints its version for every encoder
    encoder.height, encoder.width = size
    encoder.pix_fmt = config.pix_fmt
    encoder.framerate, encoder.time_base = fps, 1 / fps


def _video_frame(picture: NDArray[np.uint8], number: int, fps: Fraction) -> av.VideoFrame:
    frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
    frame.pts, frame.time_base = number, 1 / fps
    return frame


def try_encoder(config: VideoConfig, size: tuple[int, int], fps: float) -> None:
    """Encode one picture of this height and width; raises `UsageError` with the encoder's reason if it fails."""
    level = av.logging.get_level()
    av.logging.set_level(av.logging.ERROR)  # otherwise the reason is not logged
    with av.logging.Capture() as log:
        try:
            if len(av.VideoFormat(config.pix_fmt).components) < 3:
                raise ValueError(f"pixel format {config.pix_fmt} has no colour")
            rate = exact_rate(fps)
            encoder = _new_encoder(config, size, rate)
            _encode(encoder, _video_frame(np.zeros((*size, 3), np.uint8), 0, rate))
            _encode(encoder, None)
        except (av.FFmpegError, ValueError) as error:
            reason = log[0][2].strip() if log else str(error)
            raise UsageError(f"cannot encode {size[1]} x {size[0]} pictures with {config}: {reason}") from error
        finally:
            av.logging.set_level(level)
