"""What an episode of `eval.json` says of itself beyond success: condition, places, drawn numbers.

Files of older versions and of other tools may hold none of it, or something else under the same name: what is not as
expected counts as not there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

from manip_il.evaluation.results import EpisodeResult, EvalResult

Place = tuple[float, float, float]  # x away from the robot, y to its left, z above the table's top [m]

UNITS = {
    "knock": "m",
    "knock_step": "steps",
    "joint_noise": "rad",
    "position_noise": "m",
    "delay": "steps",
    "mass": "kg",
    "size": "m",
    "camera_shift": "m",
    "camera_turn": "deg",
    "light_turn": "deg",
}
_PARTS = {"colour": ("red", "green", "blue")}  # of other vectors, the length is what counts


def condition_of(episode: EpisodeResult) -> str:
    """Return the name of the condition that it ran under; empty where nothing says."""
    name = episode.detail.get("condition")
    return name if isinstance(name, str) else ""


def by_condition(result: EvalResult) -> dict[str, tuple[EpisodeResult, ...]]:
    """Return condition -> its episodes, in the order in which conditions first come."""
    groups: dict[str, list[EpisodeResult]] = {}
    for episode in result.episodes:
        groups.setdefault(condition_of(episode), []).append(episode)
    return {name: tuple(episodes) for name, episodes in groups.items()}


def start_of(episode: EpisodeResult) -> Place | None:
    """Return where the object started, or the hand where the task has no object."""
    return _thing(episode, "start")


def end_of(episode: EpisodeResult) -> Place | None:
    """Return where the same ended."""
    return _thing(episode, "end")


def goal_of(episode: EpisodeResult) -> Place | None:
    """Return where it was to go."""
    return _place(episode.detail.get("goal"))


def has_object(result: EvalResult) -> bool:
    """Return whether any episode tells of an object; without one the hand itself goes to the goal."""
    starts = [episode.detail.get("start") for episode in result.episodes]
    return not any(isinstance(start, Mapping) for start in starts) or any(
        isinstance(start, Mapping) and _place(start.get("object")) is not None for start in starts
    )


def drawn_numbers(episode: EpisodeResult) -> dict[str, float]:
    """Return every drawn number by its name and unit, `mass [kg]`: parts of a colour, lengths of other vectors."""
    drawn = episode.detail.get("drawn")
    if not isinstance(drawn, Mapping):
        return {}
    return {
        name: value
        for key, given in drawn.items()
        for name, value in _numbers(str(key), given, UNITS.get(str(key)))
        if math.isfinite(value)
    }


def _numbers(name: str, given: Any, unit: str | None) -> Iterator[tuple[str, float]]:
    if isinstance(given, Mapping):  # one value a camera
        for key, value in given.items():
            yield from _numbers(f"{name} {key}", value, unit)
    elif _is_number(given):
        yield name + (f" [{unit}]" if unit else ""), float(given)
    elif isinstance(given, Sequence) and not isinstance(given, str) and given and all(map(_is_number, given)):
        parts = _PARTS.get(name, ())
        if len(parts) == len(given):
            yield from ((f"{name}, {part}", float(value)) for part, value in zip(parts, given, strict=True))
        else:
            yield name + (f" [{unit}]" if unit else ", length"), math.hypot(*given)


def _thing(episode: EpisodeResult, when: Literal["start", "end"]) -> Place | None:
    places = episode.detail.get(when)
    if not isinstance(places, Mapping):
        return None
    return _place(places.get("object", places.get("hand")))


def _place(given: Any) -> Place | None:
    if not isinstance(given, Sequence) or isinstance(given, str) or len(given) != 3:
        return None
    if not all(_is_number(value) and math.isfinite(value) for value in given):
        return None
    x, y, z = given
    return float(x), float(y), float(z)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
