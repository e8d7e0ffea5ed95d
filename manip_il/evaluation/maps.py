"""Views from above and from the side: where episodes start, end and fail, and the paths of hand and object."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from manip_il.evaluation.comparison import Arm, Comparison
from manip_il.evaluation.episodes import EpisodeResult, Place, moving_thing
from manip_il.evaluation.report_data import Paths
from manip_il.evaluation.results import EvalResult
from manip_il.mdp import F64

Outcome = Literal["solved", "shared", "failed"]  # shared: failed, and by the other side of a comparison too
LAYERS: tuple[Outcome, ...] = ("solved", "shared", "failed")  # later ones are drawn on top
WIDTH, MARGIN = 320.0, 26.0  # of one view [px]
MAP_HEIGHT, PATHS_HEIGHT = 300.0, 230.0  # [px]
MAX_MARKS = 600  # of one outcome; more would hide each other
MAX_POINTS = 160  # of one line; more would only make the file larger
CROWDED = 80  # failures from which on they are drawn smaller
_BAR_LENGTHS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # [m]


@dataclass(frozen=True)
class View:
    """A flat picture of the world: the axes to the right and upwards, and one scale for both."""

    right: int
    up: int
    low: F64  # (2,) [m], lower left corner
    scale: float  # [px/m]
    height: float  # [px]

    def project(self, points: F64) -> F64:
        """Return world points (T, 3) [m] as pixels (T, 2)."""
        flat = (points[:, [self.right, self.up]] - self.low) * self.scale
        return np.column_stack([MARGIN + flat[:, 0], self.height - MARGIN - flat[:, 1]])

    @property
    def name(self) -> str:
        """The direction that one looks from."""
        return "from above" if (self.right, self.up) == (0, 1) else "from the side"

    @property
    def bar(self) -> float:
        """Length of the bar that shows the scale, round and at most 60 pixels where possible [m]."""
        return max((length for length in _BAR_LENGTHS if length * self.scale <= 60), default=_BAR_LENGTHS[0])


def fit_view(points: F64, right: int, up: int, height: float) -> View:
    """Return the view that has all `points` (T, 3) [m] inside, as large as they allow."""
    flat = points[:, [right, up]]
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = np.array([WIDTH, height]) - 2 * MARGIN
    size = np.maximum(high - low, 0.02)  # [m]: where nothing moved there is still a picture
    scale = float((room / size).min())
    return View(right, up, (low + high) / 2 - room / scale / 2, scale, height)


@dataclass(frozen=True)
class MapMark:
    """One episode on the map; places in the world frame [m]. end: of object or hand, None where not known."""

    outcome: Outcome
    start: Place
    goal: Place
    end: Place | None = None
    words: str = ""


class DrawnMark(NamedTuple):
    """A mark in one view [px]. end: None where there is none inside the picture."""

    mark: MapMark
    start: Sequence[float]
    goal: Sequence[float]
    end: Sequence[float] | None


@dataclass(frozen=True)
class FailureMap:
    """Two views of the same marks. name: of the policy. moving: what is to reach the goal."""

    marks: tuple[MapMark, ...]
    name: str
    moving: Literal["object", "hand"]

    @cached_property
    def views(self) -> list[tuple[View, list[DrawnMark]]]:
        """Views from above and from the side, with the marks that are drawn, the lowest layer first."""
        places = np.array([place for mark in self.marks for place in (mark.start, mark.goal)], dtype=np.float64)
        views = [fit_view(places, 0, up, MAP_HEIGHT) for up in (1, 2)]
        kept = _thinned(self.marks)
        return [(view, _draw(kept, view)) for view in views]

    @property
    def failed(self) -> int:
        """Number of failed episodes, shared ones among them."""
        return sum(mark.outcome != "solved" for mark in self.marks)

    @property
    def crowded(self) -> bool:
        """Whether marks are drawn smaller."""
        return self.failed > CROWDED

    @property
    def thinning_note(self) -> str:
        """Sentence about episodes that are not drawn; empty where all are."""
        left_out = len(self.marks) - len(_thinned(self.marks))
        if not left_out:
            return ""
        return f"{left_out:,} of {len(self.marks):,} episodes are left out of the map, evenly, to keep it readable."


def failure_map(result: EvalResult) -> FailureMap | None:
    """Return the map of an evaluation; None where no episode has its places."""
    found = (_map_mark(episode, "solved" if episode.success else "failed") for episode in result.episodes)
    marks = tuple(mark for mark in found if mark is not None)
    return FailureMap(marks, result.policy, moving_thing(result.episodes)) if marks else None


def paired_maps(comparison: Comparison) -> list[FailureMap]:
    """Return the maps of both arms, marks in the order of the test episodes; none where no episode has its places.

    `failed`: the arm failed where the other did not, with several training seeds in more of them; `shared`: it failed,
    and the other at least as often.
    """
    moving = moving_thing(comparison.left.members[0].result.episodes)
    failures = [_failures(arm) for arm in comparison.arms]
    both = [_arm_marks(arm, *counts) for arm, counts in zip(comparison.arms, (failures, failures[::-1]), strict=True)]
    maps = [FailureMap(marks, name, moving) for marks, name in zip(both, comparison.names, strict=True)]
    return maps if all(both) else []


class DrawnPaths(NamedTuple):
    """Hand, object and goal in one view [px]: lines (T, 2), the goal (2,), None where there is none."""

    view: View
    goal: F64 | None
    hand: F64
    object: F64


def draw_paths(paths: Paths) -> list[DrawnPaths]:
    """Return the paths from above, and from the side: height over x or y, whichever they use more [px]."""
    goal = np.empty((0, 3)) if paths.goal is None else paths.goal[None]
    points = np.vstack([paths.hand, paths.obj, goal])
    spread = np.ptp(points, axis=0)
    views = [fit_view(points, *axes, PATHS_HEIGHT) for axes in ((0, 1), (0 if spread[0] >= spread[1] else 1, 2))]
    lines = [line[_evenly(len(line), MAX_POINTS)] for line in (paths.hand, paths.obj)]
    return [DrawnPaths(view, next(iter(view.project(goal)), None), *map(view.project, lines)) for view in views]


def _map_mark(episode: EpisodeResult, outcome: Outcome) -> MapMark | None:
    start, goal = episode.start, episode.goal
    if start is None or goal is None:
        return None
    words = [f"seed {episode.seed}", episode.condition, "solved" if episode.success else "failed"]
    if not episode.success and episode.phase_at_end:
        words.append(f"ended in {episode.phase_at_end}")
    return MapMark(outcome, start, goal, episode.end, ", ".join(filter(None, words)))


def _failures(arm: Arm) -> Mapping[int, int]:
    """Test seed -> number of training seeds in which the arm failed."""
    return Counter(e.seed for member in arm.members for e in member.result.episodes if not e.success)


def _arm_marks(arm: Arm, own: Mapping[int, int], others: Mapping[int, int]) -> tuple[MapMark, ...]:
    count = len(arm.members)
    marks: list[MapMark] = []
    for episode in arm.members[0].result.episodes:
        failures = own[episode.seed]
        outcome: Outcome = "solved" if not failures else "failed" if failures > others[episode.seed] else "shared"
        mark = _map_mark(episode, outcome)
        if mark and count > 1:  # ends differ between training seeds
            mark = replace(mark, end=None, words=f"seed {episode.seed}, failed in {failures} of {count} training seeds")
        marks += [mark] if mark else []
    return tuple(marks)


def _thinned(marks: Sequence[MapMark]) -> list[MapMark]:
    layers = ([mark for mark in marks if mark.outcome == outcome] for outcome in LAYERS)
    return [these[index] for these in layers for index in _evenly(len(these), MAX_MARKS)]


def _draw(marks: Sequence[MapMark], view: View) -> list[DrawnMark]:
    places = np.array([(mark.start, mark.goal, mark.end or mark.goal) for mark in marks], dtype=np.float64)
    pixels = view.project(places.reshape(-1, 3)).reshape(-1, 3, 2).tolist()
    edge = MARGIN / 2
    drawn: list[DrawnMark] = []
    for mark, (start, goal, (x, y)) in zip(marks, pixels, strict=True):
        inside = edge < x < WIDTH - edge and edge < y < view.height - edge
        has_end = mark.outcome != "solved" and mark.end is not None and inside
        drawn.append(DrawnMark(mark, start, goal, (x, y) if has_end else None))
    return drawn


def _evenly(count: int, most: int) -> list[int]:
    """Up to `most` of the indices 0 to `count` - 1, evenly apart, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
