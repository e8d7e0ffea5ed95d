"""`report.html`: a run's whole story in one file that opens with no network and no scripts."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

from manip_il.data.atomic import write_file
from manip_il.evaluation import curve_sections, sections
from manip_il.evaluation.report_data import (
    CurvePoint,
    Film,
    LearningCurve,
    Paths,
    PolicyRow,
    Report,
    Strip,
)

__all__ = [
    "CurvePoint",
    "Film",
    "LearningCurve",
    "Paths",
    "PolicyRow",
    "Report",
    "Strip",
    "render_page",
    "render_report",
    "write_page",
    "write_report",
]

# The browser itself refuses whatever would reach outside the file.
POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"


def render_report(report: Report) -> str:
    """Return the page as one string of HTML."""
    return render_page(
        report.title,
        [
            sections.header(report),
            sections.results(report),
            curve_sections.curve(report.curve) if report.curve and report.curve.points else "",
            sections.pictures(report),
            sections.making(report),
        ],
    )


def render_page(title: str, body: Sequence[str]) -> str:
    """Return a whole page around the parts of its body."""
    css = files("manip_il.evaluation").joinpath("report.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
        f"<title>{escape(title)}</title><style>{css}</style></head>\n"
        f"<body><main>{''.join(body)}</main></body></html>\n"
    )


def write_report(path: Path, report: Report) -> None:
    """Write the page to `path`, whole or not at all, creating its folder."""
    write_page(path, render_report(report))


def write_page(path: Path, html: str) -> None:
    """Write a rendered page to `path`, whole or not at all, creating its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, html.encode())
