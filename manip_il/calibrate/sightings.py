"""Pictures of the board in a LeRobot dataset: where its corners are seen while the arm rests."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from manip_il.calibrate.board import RULER, SQUARE, corners_in
from manip_il.calibrate.servos import angles_of
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.errors import ManipError
from manip_il.mdp import F64, I64
from manip_il.robots.robot import WRIST, Robot
from manip_il.robots.table import PLACED

PLACES, RESTS = 3, 12  # least numbers of places of the board, and of pictures by the wrist camera
_STILL, _REST = np.radians(0.3), 0.3  # joints at rest move less [rad] in this time [s]
_MOST = 60  # pictures of a place of the board
_CORNERS = 8  # least number in a picture
_SHARP = 0.3  # least sharpness, as a share of the camera's median
# why a picture is not used
MOVING = "the arm moves"
UNSEEN = "no board"
HALF = f"fewer than {_CORNERS} corners of the board"
BLURRED = "blurred"
ODD = "does not fit the others"


@dataclass(frozen=True)
class Sighting:
    """The board in one picture.

    Attributes:
        camera: Name of the camera.
        place: Number of the place where the board lies: the episode.
        row: Row of the picture in the dataset.
        joints: The arm's joint angles as its encoders have them, (arm,) [rad].
        corners: Positions of the corners on the board, (c, 3) [m].
        pixels: Where they are in the picture, across and down, (c, 2).
        sharpness: Higher in sharper pictures.
    """

    camera: str
    place: int
    row: int
    joints: F64
    corners: F64
    pixels: F64
    sharpness: float = 1.0


@dataclass(frozen=True)
class Sightings:
    """What cameras saw of the board.

    Attributes:
        sizes: Width and height of each camera's pictures [pixels].
        used: The sightings.
        thrown: How many pictures are not used, by camera and reason.
    """

    sizes: dict[str, tuple[int, int]]
    used: list[Sighting]
    thrown: Counter[tuple[str, str]]


def sightings_of(
    dataset: Dataset, robot: Robot, ruler: float, on_picture: Callable[[], None] = lambda: None
) -> Sightings:
    """Find the board in the pictures of an arm at rest, one picture a rest.

    Args:
        dataset: With `observation.state` and a wrist camera; each episode has the board elsewhere.
        robot: The arm.
        ruler: Length of the sheet's line of 100 mm [mm].
        on_picture: Called after every picture.

    Raises:
        MismatchError: If the state is not the arm's joints.
        ManipError: If the dataset does not show the board often enough.
    """
    keys = {name: s.IMAGES + name for name in PLACED if s.IMAGES + name in dataset.cameras}
    if WRIST not in keys:
        there = ", ".join(dataset.cameras) or "none"
        raise ManipError(f"{dataset.root} has cameras {there}; expected {s.IMAGES}{WRIST}")
    [state] = angles_of(dataset, robot, [s.STATE])
    sizes: dict[str, tuple[int, int]] = {}
    for name, key in keys.items():
        height, width = dataset.features[key].picture_size
        sizes[name] = width, height
    found = Sightings(sizes, [], Counter())
    markers = 0
    for place in range(len(dataset.episodes.start)):
        rows = dataset.rows_of(place)
        rests = rows[_rests(state[rows], dataset.fps)]
        for name, key in keys.items():
            found.thrown[name, MOVING] += len(rows) - len(rests)
            for row in rests:
                [picture] = dataset.frames(key, np.array([row]))
                seen, count = look(picture, ruler, (name, place, int(row)), state[row, :-1])
                markers += count
                if isinstance(seen, str):
                    found.thrown[name, seen] += 1
                else:
                    found.used.append(seen)
                on_picture()
    sharp = _without_blurred(found)
    require_enough(sharp.used, f"{dataset.root}", markers)
    return sharp


def require_enough(used: Sequence[Sighting], what: str, markers: int = 0) -> None:
    """Check that there are enough sightings.

    Args:
        used: The sightings.
        what: Where they are from, for messages.
        markers: Number of markers of any board that were seen.

    Raises:
        ManipError: If there are not.
    """
    if not used:
        why = "only another board is seen" if markers else "no board is seen"
        raise ManipError(f"{what}: {why} while the arm rests; expected that of `robot board`")
    rests = [one for one in used if one.camera == WRIST]
    places = len({one.place for one in rests})
    if len(rests) < RESTS or places < PLACES:
        raise ManipError(
            f"{what}: the wrist camera sees the board in {len(rests)} pictures of an arm at rest,"
            f" at {places} places; expected {RESTS} or more, at {PLACES} or more (an episode each)"
        )


def _rests(state: F64, fps: float) -> I64:
    """Return the middle frames of an episode's rests, (r,), of joints (T, n) [rad]."""
    length = round(_REST * fps)
    windows = np.lib.stride_tricks.sliding_window_view(state, min(length, len(state)), axis=0)
    still = np.append(False, np.append((np.ptp(windows, axis=-1) < _STILL).all(1), False))
    starts, stops = np.flatnonzero(np.diff(still.astype(int))).reshape(-1, 2).T
    middles = (starts + stops - 1 + length) // 2
    return middles[np.linspace(0, len(middles) - 1, min(len(middles), _MOST)).astype(int)]


def look(
    picture: NDArray[np.uint8], ruler: float, where: tuple[str, int, int], joints: F64
) -> tuple[Sighting | str, int]:
    """Return a sighting, or why there is none, and the number of markers in the picture.

    Args:
        picture: The picture, RGB, (height, width, 3).
        ruler: Length of the sheet's line of 100 mm [mm].
        where: Camera, place and row of the sighting.
        joints: The arm's joint angles, (arm,) [rad].
    """
    corners, pixels, markers = corners_in(picture, SQUARE * ruler / RULER)
    if len(corners) < _CORNERS:
        return HALF if len(corners) else UNSEEN, markers
    low, high = pixels.min(0).astype(int), pixels.max(0).astype(int)
    part = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)[low[1] : high[1], low[0] : high[0]]
    # the share of edges in a picture falls as the board is nearer
    square = np.sqrt(np.prod(high - low) / len(corners))
    sharpness = cv2.Laplacian(part, cv2.CV_64F).var() / max(1.0, part.var()) * square
    return Sighting(*where, joints, corners, pixels, float(sharpness)), markers


def _without_blurred(found: Sightings) -> Sightings:
    used: list[Sighting] = []
    thrown = found.thrown.copy()
    for name in found.sizes:
        seen = [one for one in found.used if one.camera == name]
        least = _SHARP * np.median([one.sharpness for one in seen]) if seen else 0.0
        used += [one for one in seen if one.sharpness >= least]
        thrown[name, BLURRED] += sum(bool(one.sharpness < least) for one in seen)
    return Sightings(found.sizes, used, thrown)
