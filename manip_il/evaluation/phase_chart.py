"""The phases of the expert's ladder that failed episodes ended in: how many, and what each means."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from manip_il.evaluation.charts import BAR_HEIGHT
from manip_il.evaluation.results import EpisodeResult
from manip_il.evaluation.svg import element, percent, title
from manip_il.mdp import Phase

NOT_TOLD = "not recorded"
# In the order in which an episode passes them; what each means with an object, and with the hand alone.
MEANINGS: dict[Phase, tuple[str, str]] = {
    Phase.OPEN: ("the fingers are closed, or not open wide enough to go around the object", ""),
    Phase.APPROACH: ("the hand is on its way to above the object", ""),
    Phase.DESCEND: ("the hand goes down to the object", ""),
    Phase.GRASP: ("the fingers are around the object and close, but do not hold it yet", ""),
    Phase.CARRY: ("the object is in the hand, on its way to the goal", "the hand is on its way to the goal"),
    Phase.AT_GOAL: (
        "the object is at the goal, but was not held there for long enough",
        "the hand is at the goal, but did not stay for long enough",
    ),
    Phase.NONE: (
        "not even the expert can continue: the object is off the table or out of reach",
        "not even the expert can continue from here",
    ),
}


@dataclass(frozen=True)
class PhaseRow:
    """A phase's name, what it means, and the failed episodes that ended in it, one count a policy."""

    name: str
    meaning: str
    counts: tuple[int, ...]


def phase_rows(policies: Sequence[Sequence[EpisodeResult]], *, has_object: bool) -> tuple[PhaseRow, ...]:
    """The ladder's phases in order, those of the task alone; then what a foreign file calls by other names."""
    counted = [Counter(e.phase_at_end or NOT_TOLD for e in episodes if not e.success) for episodes in policies]
    meanings = {phase.name.lower(): words[0 if has_object else 1] for phase, words in MEANINGS.items()}
    others = sorted({name for counts in counted for name in counts} - meanings.keys())
    rows = [PhaseRow(name, words, tuple(c[name] for c in counted)) for name, words in meanings.items()]
    rows += [PhaseRow(name, "", tuple(c[name] for c in counted)) for name in others]
    return tuple(row for row in rows if row.meaning or any(row.counts))


def phase_words(phase: str, *, has_object: bool) -> str:
    """What a phase means; empty for one that the ladder does not have."""
    named = {known.name.lower(): words for known, words in MEANINGS.items()}
    return named.get(phase, ("", ""))[0 if has_object else 1]


def phase_chart(rows: Sequence[PhaseRow], kinds: Sequence[str], names: Sequence[str]) -> str:
    """A histogram lying on its side. kinds, names: of the policies, for the bars' colours and words."""
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
