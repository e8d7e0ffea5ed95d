"""A certificate as plain, aligned lines."""

from __future__ import annotations

from collections.abc import Sequence

from manip_il.evaluation.certificate import Certificate, Row
from manip_il.evaluation.statistics import CONFIDENCE

NONE = "-"
SHOWN = 6  # seeds of failures in a line at most


def certificate_lines(certificate: Certificate) -> list[str]:
    """Return the table of recoveries, the table of wrong actions, and what they say in words."""
    settings = certificate.settings
    horizon = f"{settings.horizon} steps ({_seconds(settings.horizon, settings.control_hz)})"
    return [
        f"expert on {certificate.robot} {certificate.task}: {settings.cases} cases a kind, --seed={settings.seed}",
        "",
        *_recoveries(certificate, horizon),
        "",
        *_wrong_actions(certificate),
        "",
        *_in_words(certificate),
    ]


def align(cells: Sequence[Sequence[str]]) -> list[str]:
    """Return columns as wide as their widest cell, under a rule behind the first line; all but the first set right."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in cells]
    return [lines[0].rstrip(), "-" * len(lines[0]), *lines[1:]]


def _recoveries(certificate: Certificate, horizon: str) -> list[str]:
    rows = [*certificate.of("start"), *certificate.of("state"), certificate.states, certificate.actions]
    rows += certificate.of("learner")
    head = ["the expert continues from", f"solved in {horizon} [{CONFIDENCE:.0%}]", "mean steps", "cases", "left out"]
    return align([head, *([row.words, *_success(row)] for row in rows)])


def _success(row: Row) -> list[str]:
    steps = NONE if row.mean_steps is None else f"{row.mean_steps:.1f}"
    return [str(row.success or NONE), steps, str(len(row.cases)), str(row.left_out)]


def _wrong_actions(certificate: Certificate) -> list[str]:
    hz = certificate.settings.control_hz
    head = ["one wrong action costs, in steps", "mean", "95th", "99th", "largest", "never solved", "cases"]
    return align([head, *(_costs(row, hz) for row in [*certificate.of("action"), certificate.actions])])


def _costs(row: Row, hz: int) -> list[str]:
    gaps = row.gaps
    if gaps is None:
        return [row.words, *[NONE] * 5, "0"]
    steps = [f"{gaps.mean:.1f}", *map(str, (gaps.p95, gaps.p99, gaps.largest))]
    costs = [f"{text} ({_seconds(float(text), hz)})" for text in steps]
    return [row.words, *costs, str(gaps.unrecovered), str(len(row.cases))]


def _in_words(certificate: Certificate) -> list[str]:
    lines = [_mu(certificate.actions, certificate.settings.control_hz)] if certificate.actions.cases else []
    for row in certificate.of("learner"):
        count = row.left_out + len(row.cases)
        lines.append(f"the policy had solved {row.left_out} of {count} before the expert's turn")
    return lines + [_failures(row) for row in certificate.rows if row.failed_seeds]


def _mu(actions: Row, hz: int) -> str:
    assert actions.gaps is not None
    assert actions.above_largest is not None
    mu = f"mu (the u of Ross et al. 2011) is at least {actions.gaps.largest} steps"
    mu += f" ({_seconds(actions.gaps.largest, hz)})"
    if actions.gaps.unrecovered:
        return f"{mu}, the whole horizon, as {actions.gaps.unrecovered} of {len(actions.cases)} were never solved"
    return f"{mu}; with {CONFIDENCE:.0%} confidence, at most {actions.above_largest:.1%} of such actions cost more"


def _failures(row: Row) -> str:
    seeds = ", ".join(map(str, row.failed_seeds[:SHOWN])) + (", ..." if len(row.failed_seeds) > SHOWN else "")
    line = f"not solved, {row.words}: seeds {seeds}"
    if not row.without_label:
        return line
    return f"{line} ({row.without_label} of {len(row.failed_seeds)} ended where the expert has no valid label)"


def _seconds(steps: float, hz: int) -> str:
    return f"{steps / hz:.3g} s"
