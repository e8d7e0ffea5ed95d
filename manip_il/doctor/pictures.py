"""Cameras: a frame for every row, of the right size, and none that is frozen, black or another camera's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.pictures import open_video
from manip_il.doctor.finding import ERROR, WARNING, Finding, delete, list_first, restore
from manip_il.errors import ManipError

F64 = NDArray[np.float64]
_TOLERANCE = 1e-4  # LeRobot's reader refuses a frame that is further from its row [s]
_EPISODES, _PICTURES, _SIDE = 100, 6, 16  # that are decoded, of each; height and width of a thumbnail
_SAME, _DARK = 1.5, 10.0  # levels, of 255: change of the most changed part of a thumbnail; mean of a picture


def check_videos(dataset: Dataset) -> Iterator[Finding]:
    """Check that every video file is there and has a frame at the time of each of its rows; none is decoded."""
    table = dataset.episodes
    for key, clips in table.clips.items():
        for name in dict.fromkeys(clips.files):
            rows = [row for row, file in enumerate(clips.files) if file == name]
            wanted = [clips.starts[row] + np.arange(table.length[row]) / dataset.fps for row in rows]
            try:
                times = _times(dataset.root / name)
            except (ManipError, av.FFmpegError, OSError, ValueError, IndexError) as problem:
                text = f"cannot be read, as if its encoder had died: {checks.one_line(problem)}"
                yield Finding(ERROR, name, text.replace(f"{dataset.root}/", ""), restore(dataset.root))
                continue
            lacking = [row for row, one in zip(rows, wanted, strict=True) if not _are_in(one, times)]
            frames = sum(map(len, wanted))
            if lacking or len(times) != frames:
                text = (
                    f"{len(times):,} frames for {frames:,} rows; episodes {list_first(table.index[lacking])} lack some"
                )
                yield Finding(ERROR, name, text, restore(dataset.root))
        spans = (clips.stops - clips.starts) * dataset.fps
        if len(bad := np.flatnonzero(~(np.abs(spans - table.length) < 0.5))):
            text = f"{spans[bad[0]]:.4g} frames from start to end of episode {bad[0]}, which has {table.length[bad[0]]}"
            yield Finding(ERROR, f"meta/episodes: videos/{key}", text, restore(dataset.root))


def _times(path: Path) -> F64:
    """Return the times of all frames of a video, ascending [s]."""
    with closing(open_video(path)) as container:
        stream = container.streams.video[0]
        tick = float(stream.time_base or 1)
        return np.sort([packet.pts * tick for packet in container.demux(stream) if packet.pts is not None])


def _are_in(wanted: F64, times: F64) -> bool:
    """Whether there is a frame within the tolerance of each time."""
    first, after = (
        np.searchsorted(times, wanted + way * _TOLERANCE, side) for way, side in ((-1, "left"), (1, "right"))
    )
    return bool((first < after).all())


def check_cameras(dataset: Dataset) -> Iterator[Finding]:
    """Check some pictures of every episode: they are decoded and have their size, and show what they should."""
    table = dataset.episodes
    chosen = np.flatnonzero(table.length > 1)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(_EPISODES, len(chosen))).astype(int)]
    rows = np.linspace(table.start[chosen], table.stop[chosen] - 1, _PICTURES, dtype=np.int64, axis=-1)
    seen: dict[str, F64] = {}
    for key in dataset.cameras:
        if dataset.features[key].is_rgb and len(rows):
            try:
                seen[key] = np.stack([_thumbnails(dataset.frames(key, one)) for one in rows])
            except ManipError as problem:
                text = checks.one_line(problem).replace(f"{dataset.root}/", "").partition("; run `manip-il")[0]
                yield Finding(ERROR, key, text, restore(dataset.root))
    moved = _moved(dataset, rows)
    for key, pictures in seen.items():
        dark = (pictures.mean(axis=(2, 3, 4)) < _DARK).mean(axis=1) > 0.5
        still = np.abs(np.diff(pictures, axis=1)).max(axis=(2, 3, 4)) < _SAME
        frozen = (still & moved).sum(axis=1) > np.maximum(1, moved.sum(axis=1) / 2)
        odd = {"is black": dark, "stands still while the joints move": frozen & ~dark}
        odd |= {f"is swapped with {other}": _swapped(pictures, seen[other]) for other in seen if other > key}
        for what, which in odd.items():
            if which.any():
                episodes = table.index[chosen[which]]
                text = f"{what} in {which.sum()} of {len(which)} episodes ({list_first(episodes)})"
                yield Finding(WARNING, key, text, delete(dataset.root, episodes))


def _thumbnails(pictures: NDArray[np.uint8]) -> F64:
    small = [Image.fromarray(one).resize((_SIDE, _SIDE), Image.Resampling.BOX) for one in pictures]
    return np.stack([np.asarray(one, dtype=np.float64) for one in small])


def _moved(dataset: Dataset, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether a joint moves by a tenth of its range from one picture to the next, (E, pictures - 1)."""
    if s.STATE not in dataset.features:
        return np.zeros((len(rows), _PICTURES - 1), bool)
    state = dataset.columns([s.STATE])[s.STATE].reshape(len(dataset), -1).astype(np.float64)
    return (np.abs(np.diff(state[rows], axis=1)) > 0.1 * np.maximum(np.ptp(state, axis=0), 1e-9)).any(axis=2)


def _swapped(left: F64, right: F64) -> NDArray[np.bool_]:
    """Return the episodes, (E,), in which two cameras look like each other in the other episodes."""
    pictures = np.stack([left.mean(axis=1), right.mean(axis=1)])
    typical = np.median(pictures, axis=1, keepdims=True)
    straight, crossed = (np.abs(pictures - one).mean(axis=(2, 3, 4)).sum(axis=0) for one in (typical, typical[::-1]))
    return (crossed < 0.5 * straight) & (straight > _DARK)


def picture_statistics(dataset: Dataset, key: str) -> dict[str, NDArray[np.generic]]:
    """Return LeRobot's statistics of a camera, (3, 1, 1), levels in [0, 1], from a hundred of its pictures."""
    rows = np.unique(np.linspace(0, len(dataset) - 1, _EPISODES).astype(np.int64))
    levels = dataset.frames(key, rows).reshape(-1, 3) / 255
    numbers = {name: getattr(np, name)(levels, axis=0) for name in ("min", "max", "mean", "std")}
    numbers |= {name: np.quantile(levels, share, axis=0) for name, share in layout.QUANTILES.items()}
    return {name: one.reshape(3, 1, 1) for name, one in numbers.items()} | {"count": np.array([len(dataset)])}


CHECKS = (check_videos, check_cameras)
