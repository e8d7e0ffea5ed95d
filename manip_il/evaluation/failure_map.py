"""Where episodes fail: starts and goals seen from above and from the side, solved ones faint, failed ones strong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np

from manip_il.evaluation.episode_facts import Place, condition_of, end_of, goal_of, start_of
from manip_il.evaluation.path_charts import MARGIN, WIDTH, View, fit_view, frame
from manip_il.evaluation.results import EpisodeResult, EvalResult
from manip_il.evaluation.svg import element, title
from manip_il.mdp import F64

Outcome = Literal["solved", "shared", "failed"]  # shared: failed, and by the other side of a comparison too
LAYERS: tuple[Outcome, ...] = ("solved", "shared", "failed")  # what is drawn later lies above
HEIGHT = 300.0  # of one view [px]
MAX_MARKS = 600  # of one outcome; more would only hide each other
CROWDED = 80  # failures from which on they are drawn smaller


@dataclass(frozen=True)
class MapMark:
    """One episode on the map; places in the world frame [m]. end: where object or hand ended, None for not told."""

    seed: int
    outcome: Outcome
    start: Place
    goal: Place
    end: Place | None = None
    words: str = ""


def map_marks(result: EvalResult) -> tuple[MapMark, ...]:
    """Return every episode whose start and goal are known, in the order of the file."""
    found = (map_mark(episode, "solved" if episode.success else "failed") for episode in result.episodes)
    return tuple(mark for mark in found if mark is not None)


def map_mark(episode: EpisodeResult, outcome: Outcome) -> MapMark | None:
    """Return the episode's mark; None where its start or its goal is not known."""
    start, goal = start_of(episode), goal_of(episode)
    if start is None or goal is None:
        return None
    words = [f"seed {episode.seed}", condition_of(episode), "solved" if episode.success else "failed"]
    if not episode.success and episode.phase_at_end:
        words.append(f"ended in {episode.phase_at_end}")
    return MapMark(episode.seed, outcome, start, goal, end_of(episode), ", ".join(filter(None, words)))


def failure_map(marks: Sequence[MapMark], name: str = "", *, stacked: bool = False) -> str:
    """Return two views of the same marks. stacked: one above the other, for two maps side by side."""
    places = np.array([place for mark in marks for place in (mark.start, mark.goal)], dtype=np.float64)
    shown = _thinned(marks)
    views = "".join(
        f'<div class="view"><span>seen {seen}</span>{_draw(shown, fit_view(places, *axes, HEIGHT), seen, name)}</div>'
        for seen, axes in (("from above", (0, 1)), ("from the side", (0, 2)))
    )
    return f'<div class="views{" one" if stacked else ""}">{views}</div>'


def map_legend(marks: Sequence[MapMark], names: dict[Outcome, str], thing: str) -> str:
    """What the marks mean. names: an outcome -> in words; thing: what moves, `object` or `hand`."""
    keys = [
        (_key(outcome), words) for outcome, words in names.items() if any(mark.outcome == outcome for mark in marks)
    ]
    failed = [mark for mark in marks if mark.outcome != "solved"]
    if any(mark.end is not None for mark in failed):
        keys.append((_svg(element("g", _cross(0.0, 0.0), class_="mark-failed"), 12), f"where the {thing} ended"))
    items = "".join(f"<li>{drawn}{escape(words)}</li>" for drawn, words in keys)
    return f'<ul class="legend map-legend">{items}</ul>'


def thinning_note(marks: Sequence[MapMark]) -> str:
    """Says so where not every episode is drawn; empty where all are."""
    left_out = len(marks) - len(_thinned(marks))
    return f"{left_out:,} of {len(marks):,} episodes are left out of the map, evenly, to keep it readable." * (
        left_out > 0
    )


def _thinned(marks: Sequence[MapMark]) -> list[MapMark]:
    kept: list[MapMark] = []
    for outcome in LAYERS:
        these = [mark for mark in marks if mark.outcome == outcome]
        chosen = np.linspace(0, len(these) - 1, min(len(these), MAX_MARKS)).round().astype(int)
        kept += [these[index] for index in chosen]
    return kept


def _draw(marks: Sequence[MapMark], view: View, seen: str, name: str) -> str:
    failed = sum(mark.outcome != "solved" for mark in marks)
    of = f" of {name}" if name else ""
    return element(
        "svg",
        title(f"Starts and goals{of} seen {seen}: {failed} failed, {len(marks) - failed} solved"),
        *(_mark(mark, view) for mark in marks),
        frame(view),
        class_="paths map crowded" if failed > CROWDED else "paths map",
        viewBox=f"0 0 {WIDTH:.0f} {view.height:.0f}",
        role="img",
    )


def _mark(mark: MapMark, view: View) -> str:
    start, goal = view.project(np.array([mark.start, mark.goal]))
    parts = [] if mark.outcome == "solved" else [_line(start, goal)]
    parts += [_start(*start), _goal(*goal)]
    if mark.outcome != "solved" and mark.end is not None:
        end = view.project(np.array([mark.end]))[0]
        if MARGIN / 2 < end[0] < WIDTH - MARGIN / 2 and MARGIN / 2 < end[1] < view.height - MARGIN / 2:
            parts.append(_cross(*end))
    words = title(f"{mark.words}: start {_metres(mark.start)}, goal {_metres(mark.goal)}")
    return element("g", words, *parts, class_=f"mark-{mark.outcome}")


def _line(start: F64, goal: F64) -> str:
    return element("line", x1=_px(start[0]), y1=_px(start[1]), x2=_px(goal[0]), y2=_px(goal[1]))


def _start(x: float, y: float) -> str:
    return element("circle", cx=_px(x), cy=_px(y), r=3)


def _goal(x: float, y: float) -> str:
    return element("rect", x=_px(x - 2.7), y=_px(y - 2.7), width=5.4, height=5.4)


def _cross(x: float, y: float) -> str:
    return element("path", class_="ended", d=f"M{x - 3:.1f} {y - 3:.1f}l6 6m0 -6l-6 6")


def _key(outcome: Outcome) -> str:
    line = "" if outcome == "solved" else _line(np.array([-9.0, 0.0]), np.array([9.0, 0.0]))
    return _svg(element("g", line, _start(-9.0, 0.0), _goal(9.0, 0.0), class_=f"mark-{outcome}"), 28)


def _svg(drawn: str, width: int) -> str:
    return element(
        "svg", drawn, class_="map-key", viewBox=f"{-width / 2:g} -6 {width} 12", width=width, height=12,
        aria_hidden="true",
    )  # fmt: skip


def _px(value: float) -> str:
    return f"{value:.1f}"


def _metres(place: Place) -> str:
    return f"({', '.join(f'{value:.3f}' for value in place)}) m"
