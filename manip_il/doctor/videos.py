"""Checks of cameras stored as video: every row has its decoded frame, at its time, of the right size."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.pictures import open_video
from manip_il.doctor.dataset import Clips, Dataset, Episodes
from manip_il.doctor.finding import Finding, error, plural, some
from manip_il.doctor.info import Feature, Info
from manip_il.doctor.pixels import Brightness, check_brightness

F64 = NDArray[np.float64]
TOLERANCE = 1e-4  # LeRobot's reader refuses a frame that is further from its row [s]
_SAMPLES = 50  # pictures a file whose brightness is looked at


@dataclass
class Film:
    """What decoding one file gave. times: of its frames, in order [s]. problem: why it could not be read to its end."""

    problem: str = ""
    times: F64 = field(default_factory=lambda: np.zeros(0))
    size: tuple[int, int] = (0, 0)  # height, width
    rate: float = 0.0
    samples: int = 0


def check_videos(dataset: Dataset) -> Iterator[Finding]:
    """Decode every frame of every video that episodes name and hold it against their rows."""
    info, episodes = dataset.info, dataset.episodes
    if info is None or episodes is None:
        return
    for feature in info.of_dtype("video"):
        clips = episodes.clips[feature.key]
        brightness = Brightness()
        for name in dict.fromkeys(clips.files):
            rows = np.array([i for i, file in enumerate(clips.files) if file == name])
            path = dataset.root / name
            if not path.is_file():
                yield error(name, f"is missing; it holds {feature.key} of {plural(len(rows), 'episode')}")
                continue
            film = decode(path, int(episodes.length[rows].sum()), brightness)
            yield from _check_film(name, film, feature, info, episodes, clips, rows)
            dataset.on_file()
        yield from check_brightness(dataset, feature, brightness)


def decode(path: Path, expected: int, brightness: Brightness | None = None) -> Film:
    """Decode a whole file, one frame in memory at a time, but at most one frame more than `expected`."""
    film, times = Film(), list[float]()
    every = max(1, expected // _SAMPLES)
    try:
        with closing(open_video(path)) as container:
            if not container.streams.video:
                return Film("holds no video")
            stream = container.streams.video[0]
            film.rate = float(stream.average_rate or 0)
            for frame in container.decode(stream):
                film.size = frame.height, frame.width
                if brightness is not None and len(times) % every == 0:
                    brightness.add(frame.to_ndarray(format="rgb24"))
                times.append(float((frame.pts or 0) * (frame.time_base or 1)))
                if len(times) > expected:
                    break
    except (av.FFmpegError, OSError, ValueError, MemoryError, ArithmeticError) as problem:
        film.problem = _explain(path, problem, len(times))
    film.times = np.sort(np.array(times, dtype=np.float64))
    return film


def _explain(path: Path, problem: Exception, decoded: int) -> str:
    if decoded:
        return f"cannot be decoded beyond {plural(decoded, 'frame')}: {_reason(problem)}"
    if path.stat().st_size == 0:
        return "is empty"
    if b"moov" not in _boxes(path):
        return "has no moov box: its encoder died before it closed the file, or the file was cut"
    return f"cannot be decoded: {_reason(problem)}"


def _reason(problem: Exception) -> str:
    return str(getattr(problem, "strerror", "") or problem or type(problem).__name__)


def _boxes(path: Path) -> set[bytes]:
    """Names of an MP4 file's outermost boxes, as far as they can be followed."""
    names: set[bytes] = set()
    with path.open("rb") as stream:
        while len(head := stream.read(16)) >= 8:
            size = int.from_bytes(head[:4])
            names.add(head[4:8])
            if size == 1:  # the size follows as 64 bits
                size = int.from_bytes(head[8:16])
            if size < 8:
                break
            stream.seek(size - len(head), 1)
    return names


def _check_film(
    name: str, film: Film, feature: Feature, info: Info, episodes: Episodes, clips: Clips, rows: NDArray[np.int64]
) -> Iterator[Finding]:
    if film.problem:
        yield error(name, film.problem)
    if not len(film.times):
        if not film.problem:
            yield error(name, "holds no frame")
        return
    if film.size != feature.picture_size:
        found, wanted = (f"{height} x {width}" for height, width in (film.size, feature.picture_size))
        yield error(name, f"pictures are {found} (height x width); {layout.INFO} says {wanted}")
    if film.rate and abs(film.rate / info.fps - 1) > 0.01:
        yield error(name, f"runs at {film.rate:.6g} frames a second; {layout.INFO} says {info.fps:.6g}")
    expected = int(episodes.length[rows].sum())
    if len(film.times) != expected:
        found = plural(len(film.times), "decoded frame")
        if len(film.times) > expected:
            found = f"more than {plural(expected, 'decoded frame')}"
        text = f"{found} for {plural(expected, 'row')}"
        yield error(name, f"{text} of {plural(len(rows), 'episode')}")
    yield from _check_times(name, film, feature, info, episodes, clips, rows)


def _check_times(
    name: str, film: Film, feature: Feature, info: Info, episodes: Episodes, clips: Clips, rows: NDArray[np.int64]
) -> Iterator[Finding]:
    """Every row's time has a frame within the tolerance, and clips are as long as their episodes."""
    without: list[int] = []
    for row in rows:
        wanted = clips.starts[row] + np.arange(int(episodes.length[row])) / info.fps
        after = np.clip(np.searchsorted(film.times, wanted), 1, max(len(film.times) - 1, 1))
        around = film.times[np.minimum([after - 1, after], len(film.times) - 1)]
        if not (np.abs(around - wanted).min(axis=0, initial=np.inf) <= TOLERANCE).all():
            without.append(int(episodes.index[row]))
    if without:
        yield error(name, f"has no frame at the time of rows of {plural(len(without), 'episode')} ({some(without)})")
    spans = (clips.stops[rows] - clips.starts[rows]) * info.fps
    bad = np.flatnonzero(~(np.abs(spans - episodes.length[rows]) < 0.5))
    if len(bad):
        number, length = episodes.index[rows[bad[0]]], episodes.length[rows[bad[0]]]
        what = f"from and to timestamps of episode {number} span {spans[bad[0]]:.4g} frames; it has {length}"
        yield error(f"meta/episodes: videos/{feature.key}", f"{what} ({plural(len(bad), 'episode')} like this)")
