"""The one picture of a dataset's card, as PNG: frames of its first episode, or the paths of its cubes from above."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.lerobot_read import camera_keys, read_frames, read_spec, read_table
from manip_il.errors import ManipError

FRAMES = 6  # of each camera
HEIGHT = 128  # of a frame [pixels]
EPISODES = 50  # whose paths are drawn
_GAP = 4
_PANEL = 280  # width and height of a drawing [pixels]
_EDGE = 34
_FINE = 3  # drawn so much larger, then made smaller: smooth lines
_INK, _FAINT, _PATH, _START, _GOAL = "#222222", "#dddddd", "#8aa4c8", "#c0392b", "#2e8b57"


@dataclass(frozen=True)
class Paths:
    """What moved in some episodes. objects: each (T, 3); goals: each (3,) [m]."""

    objects: tuple[NDArray[Any], ...]
    goals: tuple[NDArray[Any], ...]


def picture_strip(root: Path) -> bytes | None:
    """Return a PNG; None for a dataset that has neither cameras nor an object and a goal among its columns."""
    keys = camera_keys(root)
    if keys:
        return _png(_frames(root, keys))
    paths = read_paths(root)
    return _png(_drawing(paths)) if paths else None


def read_paths(root: Path) -> Paths | None:
    """Return where the object of each episode went and should go; None where no column says so."""
    try:
        names = read_spec(root).environment_state_names
    except ManipError:
        return None  # another program's dataset
    if not {f"{thing}.{axis}" for thing in ("object", "goal") for axis in "xyz"} <= set(names):
        return None
    table = read_table(root, [s.ENVIRONMENT_STATE, layout.EPISODE_INDEX])
    index, values = table[layout.EPISODE_INDEX], table[s.ENVIRONMENT_STATE]
    if not len(index):
        return None
    columns = {thing: [names.index(f"{thing}.{axis}") for axis in "xyz"] for thing in ("object", "goal")}
    episodes = [values[index == episode] for episode in np.unique(index)[:EPISODES]]
    goals = tuple(rows[0, columns["goal"]] for rows in episodes)
    return Paths(tuple(rows[:, columns["object"]] for rows in episodes), goals)


def _frames(root: Path, keys: Sequence[str]) -> Image.Image:
    """One row a camera, evenly spaced frames of the first episode."""
    rows: list[list[Image.Image]] = []
    for key in keys:
        pictures = read_frames(root, key, 0)
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


def _drawing(paths: Paths) -> Image.Image:
    """From above and from the side, to one scale, with a legend."""
    everything = np.concatenate([*paths.objects, np.stack(paths.goals)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    scale = (_PANEL - 2 * _EDGE) / max(float((high - low).max()), 0.05)  # [pixels/m]
    canvas = Image.new("RGB", (2 * _PANEL * _FINE, (_PANEL + _EDGE) * _FINE), "white")
    pen = ImageDraw.Draw(canvas)
    for number, (across, up, title) in enumerate(((0, 1, "from above: x, y"), (0, 2, "from the side: x, z"))):
        middle = (low + high) / 2
        origin = np.array([(number + 0.5) * _PANEL, _PANEL / 2])

        def place(points: NDArray[Any], axes: Any = (across, up), middle: Any = middle, origin: Any = origin) -> Any:
            shift = (points[..., list(axes)] - middle[list(axes)]) * scale * (1, -1)
            return (origin + shift) * _FINE

        _panel(pen, number, title)
        for rows, goal in zip(paths.objects, paths.goals, strict=True):
            pen.line([tuple(one) for one in place(rows)], fill=_PATH, width=_FINE)
            _square(pen, place(rows[0]))
            _ring(pen, place(goal))
        if number == 0:
            _ruler(pen, scale)
    _legend(pen, len(paths.objects))
    return canvas.resize((canvas.width // _FINE, canvas.height // _FINE), Image.Resampling.LANCZOS)


def _panel(pen: ImageDraw.ImageDraw, number: int, title: str) -> None:
    left = number * _PANEL
    box = [(left + 6) * _FINE, 6 * _FINE, (left + _PANEL - 6) * _FINE, (_PANEL - 6) * _FINE]
    pen.rectangle(box, outline=_FAINT, width=_FINE)
    _text(pen, left + 12, 9, title)


def _ruler(pen: ImageDraw.ImageDraw, scale: float) -> None:
    """0.1 m, as long as it is in the drawing."""
    y, left = _PANEL - 16, 16
    pen.line([left * _FINE, y * _FINE, (left + 0.1 * scale) * _FINE, y * _FINE], fill=_INK, width=_FINE)
    _text(pen, left + 0.1 * scale + 6, y - 8, "0.1 m")


def _legend(pen: ImageDraw.ImageDraw, episodes: int) -> None:
    y = _PANEL + 12
    _square(pen, np.array([18, y]) * _FINE)
    _text(pen, 28, y - 8, "object at the start")
    _ring(pen, np.array([178, y]) * _FINE)
    _text(pen, 188, y - 8, "goal")
    pen.line([250 * _FINE, y * _FINE, 274 * _FINE, y * _FINE], fill=_PATH, width=_FINE)
    _text(pen, 282, y - 8, f"the object's path, {episodes} episode{'s' if episodes > 1 else ''}")


def _square(pen: ImageDraw.ImageDraw, at: Any) -> None:
    x, y, half = float(at[0]), float(at[1]), 3.5 * _FINE
    pen.rectangle([x - half, y - half, x + half, y + half], fill=_START)


def _ring(pen: ImageDraw.ImageDraw, at: Any) -> None:
    x, y, half = float(at[0]), float(at[1]), 4.5 * _FINE
    pen.ellipse([x - half, y - half, x + half, y + half], outline=_GOAL, width=2 * _FINE)


def _text(pen: ImageDraw.ImageDraw, x: float, y: float, text: str) -> None:
    pen.text((x * _FINE, y * _FINE), text, fill=_INK, font=ImageFont.load_default(12 * _FINE))


def _png(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
