"""`report.html`: one file that needs no network and no scripts, rendered from the templates beside this module."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any, ClassVar

from jinja2 import Environment, PackageLoader, StrictUndefined

from manip_il.data.atomic import write_file
from manip_il.errors import ManipError
from manip_il.evaluation.curves import CurveCharts
from manip_il.evaluation.intervals import Proportion, format_percent
from manip_il.evaluation.maps import draw_paths
from manip_il.evaluation.report_data import Film, LearningCurve, Paths, PolicyRow, Strip, flatten, format_seconds
from manip_il.evaluation.tables import Table, policy_table

# Failures first: they are what one can act on.
_OUTCOMES: tuple[tuple[bool | None, str], ...] = ((None, ""), (False, "Failures"), (True, "Successes"))
_MOST_COLUMNS = 8  # of a picture strip
_INTERVAL = re.compile(r"(.*?) ([\[(].*)", re.DOTALL)


@dataclass(frozen=True)
class Bar:
    """A success rate as a bar, with its interval or with the rates of training seeds as dots.

    kind: CSS class of its colour.
    """

    name: str
    kind: str
    rate: float
    words: str
    interval: tuple[float, float] | None = None
    dots: tuple[float, ...] = ()

    @classmethod
    def of(cls, name: str, kind: str, *successes: Proportion) -> Bar:
        """Return the bar of one success rate, or of the mean over training seeds."""
        if len(successes) == 1:
            [success] = successes
            return cls(name, kind, success.rate, str(success), success.interval)
        rates = tuple(success.rate for success in successes)
        mean = sum(rates) / len(rates)
        words = f"{format_percent(mean)}, training seeds {', '.join(map(format_percent, rates))}"
        return cls(name, kind, mean, words, dots=rates)


@dataclass(frozen=True, kw_only=True)
class Report:
    """The parts that every report has. Empty parts are left out of the page.

    verdict: the first sentence, with its numbers. facts: further sentences. command: that made it. curve: of a run.
    pictures_note: such as why there are paths and no films. timings: by name [s]. config, fingerprint: nested mappings.
    """

    template: ClassVar[str] = "report.html.j2"
    title: str
    verdict: str
    command: str
    facts: tuple[str, ...] = ()
    curve: LearningCurve | None = None
    films: tuple[Film, ...] = ()
    strips: tuple[Strip, ...] = ()
    paths: tuple[Paths, ...] = ()
    pictures_note: str = ""
    config: Mapping[str, Any] = field(default_factory=dict[str, Any])
    fingerprint: Mapping[str, Any] = field(default_factory=dict[str, Any])
    timings: Mapping[str, float] = field(default_factory=dict[str, float])

    def __post_init__(self) -> None:
        for what in ("title", "verdict", "command"):
            if not getattr(self, what).strip():
                raise ManipError(f"report {self.title!r}: {what} is empty")

    @cached_property
    def pictures(self) -> list[tuple[str, list[Film], list[Strip], list[Paths]]]:
        """Pictures by outcome, each outcome under its heading, those of unknown outcome first and without one."""
        found = [
            (
                heading,
                [one for one in self.films if one.success is success],
                [one for one in self.strips if one.success is success],
                [one for one in self.paths if one.success is success],
            )
            for success, heading in _OUTCOMES
        ]
        return [group for group in found if any(group[1:])]

    @cached_property
    def curves(self) -> CurveCharts | None:
        """Success against cost; None without a curve."""
        return CurveCharts.of(self.curve) if self.curve else None

    def render(self) -> str:
        """Return the page as one string of HTML."""
        return _environment().get_template(self.template).render(report=self)

    def write(self, path: Path) -> None:
        """Write the page to `path`, whole or not at all, creating its folder."""
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, self.render().encode())


@dataclass(frozen=True, kw_only=True)
class RunReport(Report):
    """The report of a run: its policies. disturbance: meaning of the disturbed column."""

    template: ClassVar[str] = "run.html.j2"
    rows: tuple[PolicyRow, ...]
    disturbance: str = ""

    def __post_init__(self) -> None:
        if not self.rows:
            raise ManipError(f"report {self.title!r} has no policy to show")
        super().__post_init__()

    @property
    def table(self) -> Table:
        """The policies in numbers."""
        return policy_table(self.rows)

    @property
    def bars(self) -> list[Bar]:
        """Their success."""
        return [Bar.of(row.name, row.kind, row.success) for row in self.rows]

    @property
    def note(self) -> str:
        """Number of episodes, method of the intervals, and the disturbance."""
        sizes = sorted({row.success.n for row in self.rows})
        episodes = f"{sizes[0]:,}" if len(sizes) == 1 else f"{sizes[0]:,} to {sizes[-1]:,}"
        note = f"Each policy ran {episodes} episodes. Intervals are Wilson's score intervals."
        return note + (f" Disturbed: {self.disturbance}." if self.disturbance else "")


def keep_together(sentence: str) -> str:
    """Return a sentence in which a number keeps its unit, and a comparison its sign, on one line."""
    return re.sub(r"(?<=\d) (?=%)|(?<=\bp) (?=[<=] )|(?<=[<=]) (?=\d)", "\u00a0", sentence)


def split_interval(cell: str) -> tuple[str, str]:
    """Return a table cell as its number, and what follows in brackets; empty where nothing does."""
    match = _INTERVAL.fullmatch(cell)
    return (match.group(1), match.group(2)) if match else (cell, "")


def strip_columns(frames: int) -> int:
    """Return the number of columns, at most 8, in which the last row of a strip is full or nearly so."""
    rows = math.ceil(frames / _MOST_COLUMNS) or 1
    return math.ceil(frames / rows) or 1


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("manip_il.evaluation"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    filters: dict[str, Any] = {
        "prose": keep_together,
        "split_interval": split_interval,
        "base64": lambda content: base64.b64encode(content).decode("ascii"),
        "percent": lambda value: f"{value:.2f}%",
        "px": lambda value: f"{value:.1f}",
        "rate": format_percent,
        "durations": lambda timings: {name: format_seconds(seconds) for name, seconds in timings.items()},
        "flatten": flatten,
        "strip_columns": strip_columns,
        "draw_paths": draw_paths,
    }
    environment.filters.update(filters)
    return environment
