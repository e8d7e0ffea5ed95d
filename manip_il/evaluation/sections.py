"""The parts of `report.html`, one function each: data in, HTML out. Everything from outside is escaped."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, Protocol

from manip_il.evaluation.charts import success_bar
from manip_il.evaluation.path_charts import side_view, top_view
from manip_il.evaluation.report_data import (
    Film,
    Paths,
    PolicyRow,
    Report,
    Strip,
    flatten,
    format_percent,
    format_seconds,
)
from manip_il.evaluation.statistics import Proportion

NOT_MEASURED = '<span class="none" aria-label="not measured">&ndash;</span>'


class Told(Protocol):
    """What every report begins and ends with."""

    @property
    def title(self) -> str:
        """What it is about."""
        ...

    @property
    def verdict(self) -> str:
        """The first sentence, in plain words with its numbers."""
        ...

    @property
    def command(self) -> str:
        """What made it."""
        ...

    @property
    def facts(self) -> Sequence[str]:
        """Further sentences under the verdict."""
        ...

    @property
    def config(self) -> Mapping[str, Any]:
        """Nested."""
        ...

    @property
    def fingerprint(self) -> Mapping[str, Any]:
        """Nested."""
        ...

    @property
    def timings(self) -> Mapping[str, float]:
        """What -> [s]."""
        ...


class Pictured(Protocol):
    """What shows episodes."""

    @property
    def films(self) -> Sequence[Film]:
        """In the order of the page."""
        ...

    @property
    def strips(self) -> Sequence[Strip]:
        """In the order of the page."""
        ...

    @property
    def paths(self) -> Sequence[Paths]:
        """In the order of the page."""
        ...

    @property
    def pictures_note(self) -> str:
        """What is to be said about them."""
        ...


# Failures first: they are what one can act on.
OUTCOMES: tuple[tuple[bool | None, str], ...] = ((None, ""), (False, "Failures"), (True, "Successes"))


def header(report: Told) -> str:
    """Return the verdict comes first; then what else can be said in a sentence."""
    facts = "".join(f"<li>{prose(fact)}</li>" for fact in report.facts)
    return (
        f'<header><p class="kicker">{escape(report.title)}</p><h1>{prose(report.verdict)}</h1>'
        f"{f'<ul class="facts">{facts}</ul>' if facts else ''}</header>"
    )


def results(report: Report) -> str:
    """Return the table, and under it the same success as bars."""
    drawn = [(row.name, success_bar(row), row.success.rate) for row in report.rows]
    return section(
        "Results",
        policy_table(report.rows),
        bars(drawn),
        _how_measured(report),
    )


def pictures(report: Pictured) -> str:
    """Films, picture strips, or where there are none, paths: by outcome where it is known, else in their order."""
    groups = [_pictures_of(report, success, heading) for success, heading in OUTCOMES]
    if not any(groups) and not report.pictures_note:
        return ""
    note = f'<p class="note">{prose(report.pictures_note)}</p>' if report.pictures_note else ""
    return section("How it looks", note, *groups)


def _pictures_of(report: Pictured, success: bool | None, heading: str) -> str:
    films = "".join(_film(film) for film in report.films if film.success is success)
    strips = [_strip(strip) for strip in report.strips if strip.success is success]
    rest = "".join([*strips, *(_paths(paths) for paths in report.paths if paths.success is success)])
    groups = [f'<div class="{kind}">{part}</div>' for kind, part in (("films", films), ("stacked", rest)) if part]
    return (f"<h3>{heading}</h3>" if heading and groups else "") + "".join(groups)


def making(report: Told) -> str:
    """Return the command, and folded away: timings, configuration and fingerprint."""
    # Word by word, so that a narrow page breaks lines between options and not inside them.
    words = " ".join(f"<span>{escape(word)}</span>" for word in report.command.split(" "))
    timings = {what: format_seconds(seconds) for what, seconds in report.timings.items()}
    return section(
        "How it was made",
        f'<pre class="command"><code>{words}</code></pre>',
        _folded("Time taken", timings),
        _folded("Configuration", flatten(report.config)),
        _folded("Fingerprint", flatten(report.fingerprint)),
    )


def policy_table(rows: Sequence[PolicyRow], named: str = "Policy") -> str:
    """Return a line each, without the columns that no row fills. named: what a row is."""
    confidence = f"{100 * rows[0].success.confidence:g} %"
    columns: list[tuple[str, list[str]]] = [
        ("Expert labels", [NOT_MEASURED if r.labels is None else f"{r.labels:,}" for r in rows]),
        (f"Success [{confidence} interval]", [_proportion(r.success) for r in rows]),
        ("Success at end", [_proportion(r.success_at_end) for r in rows]),
        (
            "Steps to success",
            [NOT_MEASURED if r.steps_to_success is None else f"{r.steps_to_success:.1f}" for r in rows],
        ),
        ("Success, disturbed", [_proportion(r.disturbed) for r in rows]),
    ]
    columns = [column for column in columns if any(cell != NOT_MEASURED for cell in column[1])]
    head = "".join(f'<th scope="col" role="columnheader">{escape(name)}</th>' for name in [named, *dict(columns)])
    body = "".join(
        f'<tr role="row"><th scope="row" role="rowheader"><i class="key {row.kind}"></i>{escape(row.name)}</th>'
        + "".join(f'<td role="cell" data-label="{escape(name)}">{cells[i]}</td>' for name, cells in columns)
        + "</tr>"
        for i, row in enumerate(rows)
    )
    # Roles are spelt out because a narrow page shows rows as cards, which would undo the table's own.
    return (
        f'<table class="results" role="table"><thead role="rowgroup"><tr role="row">{head}</tr></thead>'
        f'<tbody role="rowgroup">{body}</tbody></table>'
    )


def bars(drawn: Iterable[tuple[str, str, float]]) -> str:
    """Name, drawn bar and rate, a line each, and the scale below."""
    lines = "".join(
        f'<div class="bar-line"><span class="bar-name">{escape(name)}</span>{bar}'
        f'<span class="bar-rate">{format_percent(rate)}</span></div>'
        for name, bar, rate in drawn
    )
    scale = "".join(f"<span>{tick} %</span>" for tick in (0, 25, 50, 75, 100))
    below = f'<div class="bar-line scale-line"><span></span><div>{scale}</div><span></span></div>'
    return f'<div class="bars">{lines}{below}</div>'


def _how_measured(report: Report) -> str:
    sizes = sorted({row.success.n for row in report.rows})
    episodes = f"{sizes[0]:,}" if len(sizes) == 1 else f"{sizes[0]:,} to {sizes[-1]:,}"
    parts = [f"Each policy ran {episodes} episodes. Intervals are Wilson's score intervals."]
    if report.disturbance:
        parts.append(f"Disturbed: {report.disturbance}.")
    return f'<p class="note">{prose(" ".join(parts))}</p>'


def _film(film: Film) -> str:
    """It plays by itself, without sound and again and again; browsers that refuse to show the poster until asked."""
    poster = f'poster="data:image/jpeg;base64,{_base64(film.poster)}" ' if film.poster else ""
    return _figure(
        film.policy,
        f'<video muted autoplay loop playsinline controls aria-label="{escape(film.policy)}" {poster}'
        f'src="data:video/mp4;base64,{_base64(film.mp4)}"></video>',
        film.caption,
    )


def _strip(strip: Strip) -> str:
    frames = "".join(
        f'<div class="frame"><img alt="{escape(strip.policy)} at {seconds:.1f} s" '
        f'src="data:image/png;base64,{_base64(png)}"><span>{seconds:.1f} s</span></div>'
        for seconds, png in strip.frames
    )
    return _figure(
        strip.policy, f'<div class="strip" style="--n:{_columns(len(strip.frames))}">{frames}</div>', strip.caption
    )


def _paths(paths: Paths) -> str:
    keys = (
        '<ul class="legend"><li><i class="key hand"></i>hand</li><li><i class="key object"></i>object</li>'
        '<li><i class="key goal"></i>goal</li><li>open circle: start, full: end</li></ul>'
    )
    lasted = f"{paths.dt * (len(paths.hand) - 1):.1f} s" if paths.dt else ""
    views = "".join(
        f'<div class="view"><span>seen {seen}</span>{drawing}</div>'
        for seen, drawing in (("from above", top_view(paths)), ("from the side", side_view(paths)))
    )
    caption = ", ".join(part for part in (paths.caption, lasted) if part)
    return _figure(paths.policy, f'<div class="views">{views}</div>{keys}', caption)


def _figure(name: str, content: str, caption: str) -> str:
    words = f"<b>{escape(name)}</b>{f' · {escape(caption)}' if caption else ''}"
    return f"<figure><figcaption>{words}</figcaption>{content}</figure>"


def _columns(frames: int) -> int:
    """Columns that leave no orphan in the last row, at most 8."""
    rows = math.ceil(frames / 8) or 1
    return math.ceil(frames / rows) or 1


def _proportion(proportion: Proportion | None) -> str:
    if proportion is None:
        return NOT_MEASURED
    low, high = proportion.interval
    return (
        f'<span class="rate">{format_percent(proportion.rate)}</span> '
        f'<span class="interval">[{100 * low:.1f}, {100 * high:.1f}]</span>'
    )


def _folded(name: str, named: Mapping[str, str]) -> str:
    return details(name, pairs(named)) if named else ""


def details(name: str, content: str) -> str:
    """Folded away under a name."""
    return f"<details><summary>{escape(name)}</summary>{content}</details>"


def pairs(named: Mapping[str, str]) -> str:
    """Return names and values, a line each."""
    rows = "".join(f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in named.items())
    return f'<dl class="pairs">{rows}</dl>'


def section(name: str, *parts: str) -> str:
    """Return a part of the page with its heading."""
    return f"<section><h2>{escape(name)}</h2>{''.join(parts)}</section>"


def prose(sentence: str) -> str:
    """Return a sentence, escaped."""
    # A number keeps its unit, and a comparison its sign, on one line.
    joined = re.sub(r"(?<=\d) (?=%)|(?<=\bp) (?=[<=] )|(?<=[<=]) (?=\d)", "\u00a0", sentence)
    return escape(joined, quote=False)


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
