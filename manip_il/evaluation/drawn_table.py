"""A table of what failures go with: success in the thirds of every coordinate and every drawn number."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from manip_il.evaluation import sections
from manip_il.evaluation.factors import THIRDS, Factor, Group
from manip_il.evaluation.report_data import format_percent
from manip_il.evaluation.statistics import format_p

COLUMNS = (*THIRDS, "corrected p")


def drawn_table(factors: Sequence[Factor]) -> str:
    """Those that failures go with, and folded away the others; empty where nothing varied."""
    if not factors:
        return ""
    shown = [factor for factor in factors if factor.shown]
    others = [factor for factor in factors if not factor.shown]
    count = f"{len(factors)} that varied" if len(factors) > 1 else "one that varied"
    found = _table(shown) if shown else f'<p class="lead">{sections.prose(_nothing(factors))}</p>'
    folded = f"{len(others)} more that varied, without a difference beyond chance" if shown else "All that varied"
    return sections.section(
        "What failures are associated with",
        found,
        sections.details(folded, _table(others)) if others else "",
        f'<p class="note">{sections.prose(_note(factors, count))}</p>',
    )


def _nothing(factors: Sequence[Factor]) -> str:
    if len(factors) == 1:
        return f"Failures are not associated with {factors[0].name} beyond chance."
    return f"Failures are associated with none of the {len(factors)} numbers that varied, beyond chance."


def _note(factors: Sequence[Factor], count: str) -> str:
    confidence = f"{100 * factors[0].groups[0].success.confidence:g} %"
    return (
        f"Success with its {confidence} interval (Wilson) in thirds of the episodes by start, goal and what was drawn; "
        "under it, the values of that third; equal values stay together. p: Fisher's exact test of all three, "
        f"corrected (Holm) for the {count}. "
        "An association with a number does not show that it causes the failures."
    )


def _table(factors: Sequence[Factor]) -> str:
    head = "".join(f'<th scope="col" role="columnheader">{name.capitalize()}</th>' for name in ("number", *COLUMNS))
    body = "".join(map(_row, factors))
    return (
        '<table class="results thirds" role="table"><thead role="rowgroup"><tr role="row">'
        f'{head}</tr></thead><tbody role="rowgroup">{body}</tbody></table>'
    )


def _row(factor: Factor) -> str:
    groups: list[Group | None] = list(factor.groups)
    if len(groups) == 2:  # of two values there is no middle
        groups.insert(1, None)
    worst = factor.groups[factor.worst] if factor.shown else None
    cells = [_cell(group, marked=group is worst) if group else sections.NOT_MEASURED for group in groups]
    cells.append(sections.prose(format_p(factor.corrected).removeprefix("p ").removeprefix("= ")))
    columns = "".join(
        f'<td role="cell" data-label="{name.capitalize()}">{cell}</td>'
        for name, cell in zip(COLUMNS, cells, strict=True)
    )
    return f'<tr role="row"><th scope="row" role="rowheader">{escape(factor.name)}</th>{columns}</tr>'


def _cell(group: Group, *, marked: bool) -> str:
    low, high = group.success.interval
    values = f"{group.low:.3g}" if group.low == group.high else f"{group.low:.3g} to {group.high:.3g}"
    # Marked by a sign and by weight, so that colour is not needed to see it.
    sign = '<span class="worst" title="lowest success">&#9660;</span> ' if marked else ""
    rate = sections.prose(format_percent(group.success.rate))
    return (
        f'<span class="third{" marked" if marked else ""}"><span>{sign}{rate}</span> '
        f'<span class="interval">[{100 * low:.1f}, {100 * high:.1f}]</span><small>{values}</small></span>'
    )
