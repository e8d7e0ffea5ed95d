"""Encode cameras as LeRobot does, but as they come: every episode is appended to a file that stays open.

LeRobot writes one file an episode and then copies all that is there so far into a new one. Its settings are restated
here, and held against the library by the tests, because importing `lerobot.configs.video` imports torch (seconds).
"""

from __future__ import annotations

import contextlib
import os
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import av
import av.logging
import numpy as np
from av.packet import Packet
from av.video.codeccontext import VideoCodecContext
from av.video.stream import VideoStream
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.pictures import Pictures, open_video
from manip_il.data.scheduling import scheduling_kept
from manip_il.data.statistics import I64, pixel_counts
from manip_il.data.video_config import VideoConfig
from manip_il.errors import ManipError, UsageError

QUEUE_BYTES = 128 * 1024 * 1024  # of pictures that wait to be encoded; an episode that is alone may be larger
_MIB = 1024 * 1024


@dataclass(frozen=True)
class Clip:
    """One camera's frames of one episode: from frame `first` of a file on; counts: their `pixel_counts`."""

    chunk: int
    file: int
    first: int
    frames: int
    counts: I64


class CameraFiles:
    """One camera's numbered video files, one open at a time; the same episodes give the same bytes."""

    def __init__(self, folder: Path, key: str, config: VideoConfig, fps: int, file_size_in_mb: float):
        self._folder, self._key, self._config, self._fps = folder, key, config, fps
        self._limit = file_size_in_mb * _MIB
        self._number = 0
        self._file: _VideoFile | None = None

    def write(self, frames: Pictures) -> Clip:
        """Append the frames of an episode. Raises `ManipError` where they cannot be encoded or written."""
        # the rule of the data files: a new one where this episode, at the file's size a frame so far, would fill it
        file = self._file
        if file and file.bytes + file.bytes / file.frames * len(frames) >= self._limit:
            self.close()
        name, chunk, number = layout.numbered(layout.VIDEO_PATH, self._number, video_key=self._key)
        try:
            if self._file is None:
                path = self._folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                self._file = _VideoFile(path, self._config, (frames.shape[1], frames.shape[2]), self._fps)
            clip = Clip(chunk, number, self._file.frames, len(frames), pixel_counts(frames))
            self._file.append(frames)
        except (av.FFmpegError, OSError) as error:
            raise ManipError(f"cannot write {name}: {error.strerror}") from error
        return clip

    def close(self) -> None:
        """Finish the open file, if any. Raises `ManipError` if it cannot be written."""
        if self._file is None:
            return
        file, self._file = self._file, None  # first: a full disk lets no file be closed twice
        name, _, _ = layout.numbered(layout.VIDEO_PATH, self._number, video_key=self._key)
        self._number += 1
        try:
            file.close()
        except (av.FFmpegError, OSError) as error:
            raise ManipError(f"cannot write {name}: {error.strerror}") from error

    def info(self) -> dict[str, Any]:
        """Return `video_info` of the first file, which must be closed."""
        return video_info(self._config, self._folder / layout.numbered(layout.VIDEO_PATH, 0, video_key=self._key)[0])


class CameraThreads:
    """Every camera's files, each encoded by a thread beside the caller (PyAV lets go of Python while it encodes)."""

    def __init__(self, cameras: Mapping[str, CameraFiles]):
        self._cameras = cameras
        self._threads = {key: ThreadPoolExecutor(1, f"encode-{key}") for key in cameras}
        self._waiting: deque[tuple[Future[Clip], int]] = deque()  # with bytes of pictures, oldest first
        self._bytes = 0

    def write(self, pictures: Mapping[str, Pictures]) -> dict[str, Future[Clip]]:
        """Add an episode's frames, which must not change from now on, to the queue; wait while it is full.

        Raises the `ManipError` of an earlier episode that could not be encoded.
        """
        clips: dict[str, Future[Clip]] = {}
        for key, frames in pictures.items():
            self._make_room(frames.nbytes)
            clips[key] = self._threads[key].submit(self._cameras[key].write, frames)
            self._waiting.append((clips[key], frames.nbytes))
            self._bytes += frames.nbytes
        return clips

    def finish(self) -> dict[str, dict[str, Any]]:
        """Wait for all frames to be on file; return `CameraFiles.info` of every camera. Raises what `write` raises."""
        self._make_room(QUEUE_BYTES)
        for camera in self._cameras.values():
            camera.close()
        return {key: camera.info() for key, camera in self._cameras.items()}

    def stop(self) -> None:
        """End the threads, whatever they are doing, and raise nothing."""
        for thread in self._threads.values():
            thread.shutdown(cancel_futures=True)
        for camera in self._cameras.values():
            with contextlib.suppress(ManipError):
                camera.close()

    def _make_room(self, size: int) -> None:
        while self._waiting and (self._waiting[0][0].done() or self._bytes + size > QUEUE_BYTES):
            clip, taken = self._waiting.popleft()
            clip.result()
            self._bytes -= taken


class _VideoFile:
    """One MP4 file that is being written."""

    def __init__(self, path: Path, config: VideoConfig, size: tuple[int, int], fps: int):
        self.path, self._config, self._size, self._fps = path, config, size, fps
        self.frames = self.bytes = 0
        # without bitexact the muxer's version is in the file; with faststart a reader finds the index at its begin
        self._container = av.open(str(path), "w", options={"movflags": "faststart", "fflags": "+bitexact"})
        self._stream = cast(VideoStream, self._container.add_stream(config.vcodec, fps, options=config.options()))
        _set_up(self._stream.codec_context, config, size, fps)

    def append(self, frames: Pictures) -> None:
        """Encode the frames as a stream of its own: so their bytes, and the file's size here, depend on no timing."""
        first = self.frames == 0
        encoder = self._stream.codec_context if first else _encoder(self._config, self._size, self._fps)
        for frame in frames:
            self._mux(encoder, _video_frame(frame, self.frames, self._fps))
            self.frames += 1
        self._mux(encoder, None)

    def close(self) -> None:
        self._container.close()

    def _mux(self, encoder: VideoCodecContext, frame: av.VideoFrame | None) -> None:
        for packet in _encode(encoder, frame):
            packet.stream = self._stream
            self.bytes += packet.size
            self._container.mux_one(packet)


def _encode(encoder: VideoCodecContext, frame: av.VideoFrame | None) -> list[Packet]:
    """Encode a frame, or what is left; the first one opens the encoder."""
    with contextlib.nullcontext() if encoder.is_open else scheduling_kept():
        return encoder.encode(frame)


def _encoder(config: VideoConfig, size: tuple[int, int], fps: int) -> VideoCodecContext:
    encoder = cast(VideoCodecContext, av.CodecContext.create(config.vcodec, "w"))
    encoder.options = config.options()
    _set_up(encoder, config, size, fps)
    return encoder


def _set_up(encoder: VideoCodecContext, config: VideoConfig, size: tuple[int, int], fps: int) -> None:
    os.environ.setdefault("SVT_LOG", "1")  # errors only: else it prints its version whenever an encoder opens
    encoder.height, encoder.width = size
    encoder.pix_fmt = config.pix_fmt
    encoder.framerate, encoder.time_base = Fraction(fps), Fraction(1, fps)


def _video_frame(picture: NDArray[np.uint8], number: int, fps: int) -> av.VideoFrame:
    frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
    frame.pts, frame.time_base = number, Fraction(1, fps)
    return frame


def try_encoder(config: VideoConfig, size: tuple[int, int], fps: int) -> None:
    """Encode one picture of this height and width; raises `UsageError` with the encoder's reason."""
    level = av.logging.get_level()
    av.logging.set_level(av.logging.ERROR)  # else there is no reason to read
    with av.logging.Capture() as log:
        try:
            if len(av.VideoFormat(config.pix_fmt).components) < 3:
                raise ValueError(f"{config.pix_fmt} has no colour")
            encoder = _encoder(config, size, fps)
            _encode(encoder, _video_frame(np.zeros((*size, 3), np.uint8), 0, fps))
            _encode(encoder, None)
        except (av.FFmpegError, ValueError) as error:
            reason = log[0][2].strip() if log else str(error)
            raise UsageError(f"cannot encode {size[1]} x {size[0]} pictures with {config}: {reason}") from error
        finally:
            av.logging.set_level(level)


def video_info(config: VideoConfig, path: Path) -> dict[str, Any]:
    """Return the entry of LeRobot's `info.json` for a camera whose video files are like `path`."""
    with contextlib.closing(open_video(path)) as container:
        stream = container.streams.video[0]
        found = {
            "video.height": stream.height,
            "video.width": stream.width,
            "video.codec": stream.codec.canonical_name,
            "video.pix_fmt": stream.pix_fmt,
            "video.fps": int(stream.base_rate or 0),
            "video.channels": len(stream.format.components),
            "has_audio": False,
        }
    settings = {"video.g": config.g, "video.crf": config.crf, "video.preset": config.preset, "video.fast_decode": 0}
    return {**found, **settings, "video.video_backend": "pyav", "video.extra_options": {}, "is_depth_map": False}
