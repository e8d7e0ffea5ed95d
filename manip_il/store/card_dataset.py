"""Facts of a dataset's card, and its picture: frames of the first episode, or its objects' paths from above."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from huggingface_hub import DatasetCardData
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import UNKNOWN_TASK, Dataset
from manip_il.data.info import DatasetInfo
from manip_il.errors import ManipError, UnknownName

_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))
_UNITS = ((3600, "hours"), (60, "minutes"), (1, "seconds"))
_SOURCES = 20  # of a merged dataset: as many are named
_DRIVERS = {"expert": "the expert", "noisy_expert": "the expert with noise", "policy": "the learner"}
FRAMES = 6  # of each camera
HEIGHT = 128  # of a frame [pixels]
EPISODES = 50  # whose paths are drawn
_GAP = 4
_PANEL = 280  # width and height of a drawing [pixels]
_EDGE = 34
_FINE = 3  # drawn so much larger, then made smaller: smooth lines
_INK, _FAINT, _PATH, _START, _GOAL = "#222222", "#dddddd", "#8aa4c8", "#c0392b", "#2e8b57"


def dataset_fields(root: Path, place: str) -> tuple[DatasetCardData, dict[str, Any]]:
    """Return metadata and fields of the card. place: USER/NAME of the repository."""
    dataset = Dataset.open(root)
    info = dataset.summary
    return _metadata(info), {
        "title": f"{info.robot} {info.task}" if info.task != UNKNOWN_TASK else place,
        "instruction": info.instruction,
        "place": place,
        "rows": list(_rows(dataset)),
        "has_labels": _has_labels(dataset),
        "provenance": list(_provenance(dataset.provenance)),
        "fingerprint": dataset.fingerprint.items(),
    }


def _metadata(info: DatasetInfo) -> DatasetCardData:
    size = next((name for most, name in _SIZES if info.frames < most), "n>10M")
    tags = dict.fromkeys(["LeRobot", "robotics", "manip_il", info.robot, info.task])
    return DatasetCardData(
        license="apache-2.0",
        task_categories=["robotics"],
        size_categories=[size],
        tags=[tag for tag in tags if tag not in (UNKNOWN_TASK, "None", "")],
        configs=[{"config_name": "default", "data_files": layout.DATA_FILES}],
    )


def _rows(dataset: Dataset) -> Iterator[tuple[str, object]]:
    info = dataset.summary
    seconds = info.frames / info.fps
    unit, name = next((unit, name) for unit, name in _UNITS if seconds >= unit or unit == 1)
    time = f"{seconds / unit:.3g} {name}"
    yield "robot", f"`{info.robot}`"
    yield "task", f"`{info.task}`: {info.instruction}"
    texts = dataset.tasks
    if len(texts) > 1:
        yield "texts", f"{len(texts)}, such as: {next(iter(texts.values()))}"
    cameras = [key.removeprefix(s.IMAGES) for key in dataset.cameras]
    yield "cameras", ", ".join(f"`{name}`" for name in cameras) or "none: states only"
    yield "episodes", f"{info.episodes:,}"
    yield "frames", f"{info.frames:,} at {info.fps:g} a second, {time}"
    if info.success is not None:
        yield "success", f"{info.success:,} of {info.episodes:,} episodes"
    if seeds := _seeds(dataset):
        yield "seeds", seeds


def _seeds(dataset: Dataset) -> str:
    try:
        seeds = np.unique(dataset.columns([s.SEED])[s.SEED])
    except UnknownName:
        return ""
    return f"{len(seeds):,}, from {seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else f"{seeds[0]}"


def _has_labels(dataset: Dataset) -> bool:
    return {s.EXECUTED_ACTION, s.LABEL_VALID} <= dataset.features.keys()


def _provenance(one: Mapping[str, Any], name: str = "") -> Iterator[str]:
    """Yield one line for each source, of any content that another program wrote there."""
    if not one:
        yield "The origin of its episodes is unknown."
        return
    sources = one.get("merged") or one.get("sources")
    if isinstance(sources, list):
        yield f"Joined from {len(sources)} datasets" + (", among them:" if len(sources) > _SOURCES else ":")
        for source in sources[:_SOURCES]:
            if isinstance(source, dict):
                inner = source.get("provenance")
                yield from _provenance(inner if isinstance(inner, dict) else {}, Path(str(source.get("name", ""))).name)
        return
    driver = str(one.get("driver", "somebody"))
    words = [
        f"{_DRIVERS.get(driver, driver)} drove",
        *(f"{key} {one[key]:g}" for key in ("round", "beta") if key in one),
    ]
    seeds = one.get("seeds")
    if isinstance(seeds, list) and len(seeds) == 2:
        words.append(f"seeds {seeds[0]} to {seeds[1]}")
    if "tried" in one:
        words.append(f"{one['tried']} episodes tried")
    yield (f"`{name}`: " if name not in ("", "dataset") else "") + ", ".join(words)


def draw_picture(root: Path) -> bytes | None:
    """Return a PNG; None for a dataset without cameras and without an object and a goal among its columns."""
    dataset = Dataset.open(root)
    if dataset.cameras:
        return _png(_frames(dataset))
    paths = read_paths(root)
    return _png(_drawing(paths)) if paths else None


def read_paths(root: Path) -> list[tuple[NDArray[Any], NDArray[Any]]]:
    """Return the object's path, (T, 3), and the goal, (3,), of the first episodes [m]; none if no columns hold them."""
    try:
        dataset = Dataset.open(root)
        names = dataset.spec.environment_state_names
    except ManipError:
        return []  # another program's dataset
    if not {f"{thing}.{axis}" for thing in ("object", "goal") for axis in "xyz"} <= set(names):
        return []
    table = dataset.columns([s.ENVIRONMENT_STATE, layout.EPISODE_INDEX])
    index, values = table[layout.EPISODE_INDEX], table[s.ENVIRONMENT_STATE]
    columns, goal = ([names.index(f"{thing}.{axis}") for axis in "xyz"] for thing in ("object", "goal"))
    episodes = [values[index == episode] for episode in np.unique(index)[:EPISODES]]
    return [(rows[:, columns], rows[0, goal]) for rows in episodes]


def _frames(dataset: Dataset) -> Image.Image:
    """Draw one row for each camera: evenly spaced frames of the first episode."""
    rows: list[list[Image.Image]] = []
    for key in dataset.cameras:
        pictures = dataset.frames(key, dataset.rows_of(0))
        picked = np.unique(np.linspace(0, len(pictures) - 1, FRAMES).round().astype(int))
        width = round(HEIGHT * pictures.shape[2] / pictures.shape[1])
        rows.append([Image.fromarray(pictures[i]).resize((width, HEIGHT), Image.Resampling.LANCZOS) for i in picked])
    width = max(sum(one.width + _GAP for one in row) - _GAP for row in rows)
    strip = Image.new("RGB", (width, len(rows) * (HEIGHT + _GAP) - _GAP), "white")
    for number, row in enumerate(rows):
        left = 0
        for one in row:
            strip.paste(one, (left, number * (HEIGHT + _GAP)))
            left += one.width + _GAP
    return strip


def _drawing(paths: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> Image.Image:
    """Draw paths from above and from the side, to one scale, with a legend."""
    lines = [np.vstack(one) for one in paths]  # each with its goal at the end
    low, high = np.concatenate(lines).min(axis=0), np.concatenate(lines).max(axis=0)
    scale = (_PANEL - 2 * _EDGE) / max(float((high - low).max()), 0.05)  # [pixels/m]
    canvas = Image.new("RGB", (2 * _PANEL * _FINE, (_PANEL + _EDGE) * _FINE), "white")
    pen = ImageDraw.Draw(canvas)
    for left, axes, title in ((0, [0, 1], "from above: x, y"), (_PANEL, [0, 2], "from the side: x, z")):
        box = [(left + 6) * _FINE, 6 * _FINE, (left + _PANEL - 6) * _FINE, (_PANEL - 6) * _FINE]
        pen.rectangle(box, outline=_FAINT, width=_FINE)
        _text(pen, left + 12, 9, title)
        origin = np.array([left + _PANEL / 2, _PANEL / 2])
        for one in lines:
            shift = (one[:, axes] - ((low + high) / 2)[axes]) * scale * (1, -1)
            *path, end = (origin + shift) * _FINE
            pen.line([tuple(at) for at in path], fill=_PATH, width=_FINE)
            _mark(pen, path[0], end)
        if left == 0:
            ruler, y = 16 + 0.1 * scale, _PANEL - 16  # of 0.1 m
            pen.line([16 * _FINE, y * _FINE, ruler * _FINE, y * _FINE], fill=_INK, width=_FINE)
            _text(pen, ruler + 6, y - 8, "0.1 m")
    _legend(pen, len(paths))
    return canvas.resize((canvas.width // _FINE, canvas.height // _FINE), Image.Resampling.LANCZOS)


def _legend(pen: ImageDraw.ImageDraw, episodes: int) -> None:
    y = _PANEL + 12
    _mark(pen, np.array([18, y]) * _FINE, np.array([178, y]) * _FINE)
    _text(pen, 28, y - 8, "object at the start")
    _text(pen, 188, y - 8, "goal")
    pen.line([250 * _FINE, y * _FINE, 274 * _FINE, y * _FINE], fill=_PATH, width=_FINE)
    _text(pen, 282, y - 8, f"the object's path, {episodes} episode{'s' if episodes > 1 else ''}")


def _mark(pen: ImageDraw.ImageDraw, start: NDArray[Any], goal: NDArray[Any]) -> None:
    """Draw a square at the start and a ring at the goal [pixels]."""
    square, ring = 3.5 * _FINE, 4.5 * _FINE
    pen.rectangle([*(start - square), *(start + square)], fill=_START)
    pen.ellipse([*(goal - ring), *(goal + ring)], outline=_GOAL, width=2 * _FINE)


def _text(pen: ImageDraw.ImageDraw, x: float, y: float, text: str) -> None:
    pen.text((x * _FINE, y * _FINE), text, fill=_INK, font=ImageFont.load_default(12 * _FINE))


def _png(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
