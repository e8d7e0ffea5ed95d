"""The phases of the expert's ladder that failed episodes ended in: how many, and what each means."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from manip_il.evaluation.charts import BAR_HEIGHT
from manip_il.evaluation.results import EpisodeResult
from manip_il.evaluation.svg import element, percent, title
from manip_il.tasks.table import TASKS
from manip_il.tasks.task import NO_PHASE

NOT_TOLD = "not recorded"
_NONE = "not even the expert can continue: an object is off the table, or something is out of reach"


@dataclass(frozen=True)
class PhaseRow:
    """A phase's name, what it means, and the failed episodes that ended in it, one count a policy."""

    name: str
    meaning: str
    counts: tuple[int, ...]


def phase_rows(policies: Sequence[Sequence[EpisodeResult]], task: str) -> tuple[PhaseRow, ...]:
    """Return the phases of a task's ladder in order; then what a foreign file calls by other names."""
    counted = [Counter(e.phase_at_end or NOT_TOLD for e in episodes if not e.success) for episodes in policies]
    meanings = _meanings(task)
    others = sorted({name for counts in counted for name in counts} - meanings.keys())
    rows = [PhaseRow(name, words, tuple(c[name] for c in counted)) for name, words in meanings.items()]
    return (*rows, *(PhaseRow(name, "", tuple(c[name] for c in counted)) for name in others))


def phase_words(phase: str, task: str) -> str:
    """What a phase means; empty for one that the task's ladder does not have."""
    return _meanings(task).get(phase, "")


def _meanings(task: str) -> dict[str, str]:
    """Name -> words, from the first rung to the last; empty for a task that is not known here."""
    if task not in TASKS:
        return {}
    return {rung.name: rung.words for rung in reversed(TASKS[task].rungs)} | {NO_PHASE: _NONE}


def phase_chart(rows: Sequence[PhaseRow], kinds: Sequence[str], names: Sequence[str]) -> str:
    """Return a histogram lying on its side. kinds, names: of the policies, for the bars' colours and words."""
    most = max((count for row in rows for count in row.counts), default=0) or 1
    lines = "".join(_line(row, kinds, names, most) for row in rows)
    return f'<div class="bars phases">{lines}</div>'


def _line(row: PhaseRow, kinds: Sequence[str], names: Sequence[str], most: int) -> str:
    bars = "".join(
        _bar(f"{name}: {count} failed episodes ended in {row.name}", kind, count / most)
        for kind, name, count in zip(kinds, names, row.counts, strict=True)
    )
    counts = "".join(f"<span>{count:,}</span>" for count in row.counts)
    meaning = f"<small>{escape(row.meaning)}</small>" if row.meaning else ""
    idle = "" if any(row.counts) else " idle"
    name = escape(row.name.replace("_", " "))
    return (
        f'<div class="bar-line{idle}"><span class="bar-name"><b>{name}</b>{meaning}</span>'
        f'<div class="bar-stack">{bars}</div><span class="bar-rate">{counts}</span></div>'
    )


def _bar(words: str, kind: str, share: float) -> str:
    height = BAR_HEIGHT - 8
    return element(
        "svg",
        title(words),
        element("rect", class_="track", width="100%", height=height, rx=4),
        element("rect", class_=f"bar {kind}", width=percent(100 * share), height=height, rx=4),
        class_="bar-chart",
        role="img",
        width="100%",
        height=height,
    )
