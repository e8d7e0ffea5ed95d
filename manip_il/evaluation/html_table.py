"""Tables of text as HTML: a table where there is room, cards on a narrow page."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from html import escape

from manip_il.evaluation import sections
from manip_il.evaluation.tables import Cells

LONG = 24  # characters of a row's name, from which on it may be broken over lines


def cells_table(cells: Cells, kinds: Mapping[str, str] | None = None, names: Collection[str] = ()) -> str:
    """Return the table without its empty columns. kinds: a row's name -> the CSS class of its colour.

    names: columns that are called by the name of something, which keeps its small letter.
    """
    cells = cells.filled()
    kinds = kinds or {}
    heads = [text if text in names else text[:1].upper() + text[1:] for text in cells.columns]
    heads[0] = heads[0].partition(",")[0]
    row_of_heads = "".join(f'<th scope="col" role="columnheader">{escape(text)}</th>' for text in heads)
    body = "".join(
        f'<tr role="row"><th scope="row" role="rowheader">{_named(row[0], kinds)}</th>'
        + "".join(
            f'<td role="cell" data-label="{escape(head)}">{_cell(text)}</td>'
            for head, text in zip(heads[1:], row[1:], strict=True)
        )
        + "</tr>"
        for row in cells.rows
    )
    # Roles are spelt out because a narrow page shows rows as cards, which would undo the table's own.
    long = " long" if any(len(row[0]) > LONG for row in cells.rows) else ""
    return (
        f'<table class="results wide{long}" role="table">'
        f'<thead role="rowgroup"><tr role="row">{row_of_heads}</tr></thead>'
        f'<tbody role="rowgroup">{body}</tbody></table>'
    )


def _named(name: str, kinds: Mapping[str, str]) -> str:
    if name not in kinds:
        return escape(name)
    return f'<span class="named"><i class="key {kinds[name]}"></i><span>{escape(name)}</span></span>'


def _cell(text: str) -> str:
    """A number, and softer what stands behind it in brackets."""
    if not text:
        return sections.NOT_MEASURED
    for opening in (" [", " ("):
        number, bracket, rest = text.partition(opening)
        if bracket:
            behind = f'<span class="interval">{sections.prose(bracket.strip() + rest)}</span>'
            return f"<span><span>{sections.prose(number)}</span> {behind}</span>"
    parts = [f"<span>{sections.prose(part)}</span>" for part in text.replace(", ", ",\n").split("\n")]
    return f"<span>{' '.join(parts)}</span>"
