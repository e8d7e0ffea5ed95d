"""`report.html`: one file without network access or scripts, rendered from the template beside this module."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from manip_il.data.atomic import write_file
from manip_il.evaluation.figures import Figure
from manip_il.evaluation.tables import Table

_INTERVAL = re.compile(r"(.*?) ([\[(].*)", re.DOTALL)


@dataclass(frozen=True)
class Still:
    """A JPEG with its caption."""

    caption: str
    content: bytes


@dataclass(frozen=True)
class Film:
    """One episode as an MP4 (H.264). title: in bold before the caption. poster: a JPEG shown until it plays."""

    title: str
    mp4: bytes
    caption: str = ""
    poster: bytes = b""


@dataclass(frozen=True)
class Section:
    """A part of a report. Empty parts are omitted. formulas: one per line; notes: paragraphs below the tables."""

    heading: str
    lead: tuple[str, ...] = ()
    formulas: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    tables: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()
    stills: tuple[Still, ...] = ()
    films: tuple[Film, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Report:
    """A page: the verdict (a first sentence with its numbers), further facts, sections, and how it was made.

    command: the command that made it. config, fingerprint: nested mappings.
    """

    title: str
    verdict: str
    command: str
    sections: tuple[Section, ...]
    facts: tuple[str, ...] = ()
    config: Mapping[str, Any] = field(default_factory=dict[str, Any])
    fingerprint: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def render(self) -> str:
        """Return the page as one string of HTML."""
        return _environment().get_template("report.html.j2").render(report=self)

    def write(self, path: Path) -> None:
        """Write the page to `path` atomically, creating its folder."""
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, self.render().encode())


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return a nested mapping flattened to `policy.hidden -> 256`, with the command line's names."""
    flat: dict[str, str] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = _plain(value)
    return flat


def _plain(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(_plain, value)) or "(empty)"
    if value is None or isinstance(value, bool):
        return str(value).lower()
    return "(empty)" if isinstance(value, Mapping) else str(value)


def _prose(words: str) -> Markup:
    """Keep numbers with their units, and comparisons with their signs, on one line; let paths break after a slash."""
    kept = re.sub(r"(?<=\d) (?=%)|(?<=\bp) (?=[<=] )|(?<=[<=]) (?=\d)", "\u00a0", words)
    return Markup(re.sub(r"(?<=\w)/(?=\w)", "/<wbr>", escape(kept)))


def _split_interval(cell: str) -> tuple[str, str]:
    """Return a table cell as its number and the bracketed text after it, empty if there is none."""
    match = _INTERVAL.fullmatch(cell)
    return (match.group(1), match.group(2)) if match else (cell, "")


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
        "prose": _prose,
        "heading": lambda column: column if "/" in column else column[:1].upper() + column[1:],
        "split_interval": _split_interval,
        "base64": lambda content: base64.b64encode(content).decode("ascii"),
        "flatten": flatten,
    }
    environment.filters.update(filters)
    return environment
