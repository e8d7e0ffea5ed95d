"""Checks of cameras: every row has its video frame or picture, of the right size and about the stored brightness."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.episode_table import EpisodeTable
from manip_il.data.info import Feature, Info
from manip_il.data.parquet_files import UNREADABLE, Shard
from manip_il.data.pictures import open_picture, open_video
from manip_il.doctor.finding import Finding, error, list_first, plural
from manip_il.doctor.patient import Patient
from manip_il.doctor.scan import F64, I64

_TOLERANCE = 1e-4  # LeRobot's reader refuses a frame that is further from its row [s]
_SAMPLES = 50  # frames a video file whose brightness is measured
_BATCH = 64  # pictures held at once
_SAMPLE_EVERY = 20  # the brightness of every 20th picture is measured
_LEVEL_TOLERANCE = 0.1  # of the range: LeRobot samples frames and pixels, before they are compressed with loss


@dataclass
class Film:
    """Result of decoding a video file. times: of its frames, ascending [s]. problem: why the rest was not decoded."""

    problem: str = ""
    times: F64 = field(default_factory=lambda: np.zeros(0))
    size: tuple[int, int] = (0, 0)  # height, width
    rate: float = 0.0  # [frames/s]
    levels: list[F64] = field(default_factory=list[F64])  # mean of R, G and B of sampled frames, in [0, 1]


def check_videos(dataset: Patient) -> Iterator[Finding]:
    """Decode every frame of every video that episodes name, and compare with their rows."""
    info, episodes = dataset.info, dataset.episodes
    if info is None or episodes is None:
        return
    for feature in info.of_dtype("video"):
        levels: list[F64] = []
        files = episodes.clips[feature.key].files
        for name in dict.fromkeys(files):
            rows = np.array([i for i, file in enumerate(files) if file == name])
            path = dataset.root / name
            if not path.is_file():
                yield error(name, f"is missing; it holds {feature.key} of {plural(len(rows), 'episode')}")
                continue
            film = decode(path, int(episodes.length[rows].sum()))
            levels += film.levels
            yield from _check_film(name, film, feature, info, len(rows), int(episodes.length[rows].sum()))
            if len(film.times):
                yield from _check_times(name, film, feature, info, episodes, rows)
            dataset.on_file()
        yield from _check_brightness(dataset, feature, levels)


def check_pictures(dataset: Patient) -> Iterator[Finding]:
    """Decode every picture that is in a data file, but for depth."""
    if dataset.info is None:
        return
    for feature in (one for one in dataset.info.of_dtype("image") if one.is_rgb):
        levels: list[F64] = []
        for shard in dataset.data_shards:
            if not shard.problem and feature.key in shard.columns:
                yield from _check_shard(shard, feature, levels)
                dataset.on_file()
        yield from _check_brightness(dataset, feature, levels)


def decode(path: Path, expected: int) -> Film:
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
                if len(times) % every == 0:
                    film.levels.append(_mean_level(frame.to_ndarray(format="rgb24")))
                times.append(float((frame.pts or 0) * (frame.time_base or 1)))
                if len(times) > expected:
                    break
    except (av.FFmpegError, OSError, ValueError, MemoryError, ArithmeticError) as problem:
        film.problem = _explain(path, problem, len(times))
    film.times = np.sort(np.array(times, dtype=np.float64))
    return film


def _explain(path: Path, problem: Exception, decoded: int) -> str:
    reason = str(getattr(problem, "strerror", "") or problem or type(problem).__name__)
    if decoded:
        return f"cannot be decoded beyond {plural(decoded, 'frame')}: {reason}"
    if path.stat().st_size == 0:
        return "is empty"
    return f"cannot be decoded, as if its encoder had died before it closed the file, or the file was cut: {reason}"


def _check_film(name: str, film: Film, feature: Feature, info: Info, episodes: int, frames: int) -> Iterator[Finding]:
    if film.problem:
        yield error(name, film.problem)
    if not len(film.times):
        if not film.problem:
            yield error(name, "holds no frame")
        return
    if film.size != feature.picture_size:
        yield error(name, f"pictures are {_compare_sizes(film.size, feature)}")
    if film.rate and abs(film.rate / info.fps - 1) > 0.01:
        yield error(name, f"runs at {film.rate:.6g} frames a second; {layout.INFO} says {info.fps:.6g}")
    if len(film.times) != frames:
        found = plural(len(film.times), "decoded frame")
        if len(film.times) > frames:
            found = f"more than {plural(frames, 'decoded frame')}"
        yield error(name, f"{found} for {plural(frames, 'row')} of {plural(episodes, 'episode')}")


def _check_times(
    name: str, film: Film, feature: Feature, info: Info, episodes: EpisodeTable, rows: I64
) -> Iterator[Finding]:
    """Check that every row's time has a frame within the tolerance, and that clips are as long as their episodes."""
    clips = episodes.clips[feature.key]
    without: list[int] = []
    for row in rows:
        wanted = clips.starts[row] + np.arange(int(episodes.length[row])) / info.fps
        after = np.clip(np.searchsorted(film.times, wanted), 1, max(len(film.times) - 1, 1))
        around = film.times[np.minimum([after - 1, after], len(film.times) - 1)]
        if not (np.abs(around - wanted).min(axis=0, initial=np.inf) <= _TOLERANCE).all():
            without.append(int(episodes.index[row]))
    if without:
        count = plural(len(without), "episode")
        yield error(name, f"has no frame at the time of rows of {count} ({list_first(without)})")
    spans = (clips.stops[rows] - clips.starts[rows]) * info.fps
    bad = np.flatnonzero(~(np.abs(spans - episodes.length[rows]) < 0.5))
    if len(bad):
        number, length = episodes.index[rows[bad[0]]], episodes.length[rows[bad[0]]]
        what = f"from and to timestamps of episode {number} span {spans[bad[0]]:.4g} frames; it has {length}"
        yield error(f"meta/episodes: videos/{feature.key}", f"{what} ({plural(len(bad), 'episode')} like this)")


def _check_shard(shard: Shard, feature: Feature, levels: list[F64]) -> Iterator[Finding]:
    place = f"{shard.name}: {feature.key}"
    bad: list[tuple[int, str]] = []
    row = 0
    try:
        for table in shard.tables([feature.key], _BATCH):
            for cell in table.column(0).to_pylist():
                if problem := _check_picture(cell, feature, levels if row % _SAMPLE_EVERY == 0 else None):
                    bad.append((row, problem))
                row += 1
    except UNREADABLE as problem:
        yield error(place, f"cannot be read: {problem}")
    if bad:
        yield error(place, f"the picture in row {bad[0][0]:,} {bad[0][1]} ({plural(len(bad), 'row')} like this)")


def _check_picture(cell: Any, feature: Feature, levels: list[F64] | None) -> str:
    """Return what is wrong with one picture; empty for nothing."""
    data = cell.get("bytes") if isinstance(cell, dict) else None
    if not isinstance(data, bytes):
        return "is not in the file"
    try:
        with open_picture(data) as picture:
            picture.load()
            size = picture.height, picture.width
            if levels is not None and feature.channels == 3:
                levels.append(_mean_level(np.asarray(picture.convert("RGB"))))
    except Exception as problem:  # damaged bytes make decoders raise anything
        return f"cannot be decoded: {problem or type(problem).__name__}"
    return "" if size == feature.picture_size else f"is {_compare_sizes(size, feature)}"


def _compare_sizes(size: tuple[int, int], feature: Feature) -> str:
    found, wanted = (f"{height} x {width}" for height, width in (size, feature.picture_size))
    return f"{found} (height x width); {layout.INFO} says {wanted}"


def _mean_level(picture: NDArray[np.generic]) -> F64:
    return picture.reshape(-1, 3).mean(axis=0) / 255


def _check_brightness(dataset: Patient, feature: Feature, levels: list[F64]) -> Iterator[Finding]:
    """Check that the stored mean is about the pictures', and between the stored minimum and maximum."""
    stats = dataset.stats
    if stats is None or not isinstance(stats.get(feature.key), dict) or feature.details.get("is_depth_map"):
        return
    place = f"{layout.STATS}: {feature.key}"
    low, mean, high = (dataset.statistic(feature.key, name) for name in ("min", "mean", "max"))
    if low is None or mean is None or high is None or not len(low) == len(mean) == len(high) == feature.channels:
        yield error(place, f"min, mean and max are not one number for each of {feature.channels} channels")
        return
    if not ((low <= mean) & (mean <= high) & (low >= 0) & (high <= 1)).all():
        yield error(place, f"mean {_format(mean)} is not between min {_format(low)} and max {_format(high)} in [0, 1]")
    if levels and len(mean) == 3:
        found = np.mean(levels, axis=0)
        if (np.abs(found - mean) > _LEVEL_TOLERANCE).any():
            yield error(place, f"mean is {_format(mean)}; the pictures' is {_format(found)}")


def _format(values: F64) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"
