"""`report.html`: one file without network access or scripts, rendered from the template beside
this module.
"""

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined

from manip_il.data.atomic import write_file
from manip_il.evaluation.figures import Figure
from manip_il.evaluation.tables import Table

REPORT_FILE = "report.html"


@dataclass(frozen=True)
class Film:
    """One episode as a film.

    Attributes:
        title: Shown in bold before the caption.
        mp4: Content of the MP4 file (H.264).
        caption: Text below the film.
    """

    title: str
    mp4: bytes
    caption: str = ""


@dataclass(frozen=True)
class Section:
    """A part of a report; what is empty is omitted.

    Attributes:
        heading: Its title.
        lead: Paragraphs below the title.
        formulas: One formula per line.
        figures: The figures.
        tables: The tables.
        notes: Paragraphs below the tables.
        films: The films.
    """

    heading: str
    lead: tuple[str, ...] = ()
    formulas: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    tables: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()
    films: tuple[Film, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Report:
    """A page of results, with how they were made.

    Attributes:
        title: The page's title.
        verdict: The first sentence, with numbers.
        sections: The parts of the page.
        facts: Further facts, one sentence each.
        command: The command line that made the page, which the command fills in.
        config: The command's options, which the command fills in.
        fingerprint: The environment's fingerprint, a nested mapping.
    """

    title: str
    verdict: str
    sections: tuple[Section, ...]
    facts: tuple[str, ...] = ()
    command: str = ""
    config: Mapping[str, Any] = field(default_factory=dict[str, Any])
    fingerprint: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def render(self) -> str:
        """Return the page as one string of HTML."""
        environment = Environment(
            loader=PackageLoader("manip_il.evaluation"),
            autoescape=True,
            trim_blocks=True,
            lstrip_blocks=True,
            undefined=StrictUndefined,
        )
        filters: dict[str, Any] = environment.filters
        filters["base64"] = lambda content: base64.b64encode(content).decode("ascii")
        filters["yaml"] = lambda tree: yaml.safe_dump(
            dict(tree), sort_keys=False, allow_unicode=True
        )
        return environment.get_template("report.html.j2").render(report=self)

    def write(self, folder: Path) -> Path:
        """Write `report.html` atomically, creating its folder; return its path."""
        path = folder / REPORT_FILE
        write_file(path, self.render().encode())
        return path
