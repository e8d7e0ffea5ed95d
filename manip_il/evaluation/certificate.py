"""`certificate.json`: the states from which the expert recovers, and the cost of one wrong action.

The cost of a state is the number of control steps until the task is solved. Where Q*(s, a) is the expert's cost of
going on after action a in state s, and V*(s) its cost of acting itself, the gap Q*(s, a) - V*(s) is the cost that the
action a adds. Ross, Gordon & Bagnell (2011, Theorem 2.2) bound imitation by the largest of them, u: a learner that errs
in a share e of the states it visits within T steps costs at most u T e more than the expert, so linearly in T where a
mistake can be undone, and not quadratically. Rajaraman et al. (2021) call it mu-recoverability. The largest gap among
drawn actions, as here, is a lower bound of u: `Row.above_largest` says how much of the draw may lie above it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from manip_il.errors import ManipError, UsageError
from manip_il.evaluation.intervals import CONFIDENCE, Proportion
from manip_il.evaluation.results import write_json
from manip_il.evaluation.tables import Table

FILE_NAME = "certificate.json"
Group = Literal["start", "state", "action", "learner"]
MAX_SEEDS = 6  # of failures in a line
_NONE = "-"


@dataclass(frozen=True, slots=True)
class Case:
    """One episode. moment: the control step from which the expert is judged.

    steps: until solved from there [control steps]; None where not within a horizon. undisturbed: the same without the
    perturbation, where known. labelled: whether the expert's last label was valid. Raises `ManipError` for impossible
    counts.
    """

    seed: int
    moment: int
    steps: int | None
    undisturbed: int | None = None
    labelled: bool = True

    def __post_init__(self) -> None:
        counts = [count for count in (self.steps, self.undisturbed) if count is not None]
        if self.moment < 0 or any(count < 1 for count in counts):
            raise ManipError(f"certificate of seed {self.seed}: {self} has impossible step counts")

    def gap(self, horizon: int) -> int | None:
        """Return Q*(s, a) - V*(s) [control steps]; the whole horizon where the expert did not recover."""
        if self.undisturbed is None:
            return None
        return horizon if self.steps is None else self.steps - self.undisturbed


@dataclass(frozen=True)
class Gaps:
    """Gaps of the cost-to-go, over the cases of a row [control steps]. unrecovered: counted as a whole horizon."""

    mean: float
    p95: int
    p99: int
    largest: int
    unrecovered: int


@dataclass(frozen=True)
class Row:
    """The cases of one kind. name, words: of the kind, short and in full; horizon: [control steps].

    left_out: episodes that give no case, as the perturbation found no place or changed nothing, or the task was solved
    before its moment.
    """

    group: Group
    name: str
    words: str
    cases: tuple[Case, ...]
    horizon: int
    left_out: int = 0

    def __post_init__(self) -> None:
        longest = max((case.steps or 0 for case in self.cases), default=0)
        if longest > self.horizon:
            raise ManipError(f"certificate, {self.words}: solved after {longest} steps of {self.horizon}")

    @property
    def success(self) -> Proportion | None:
        """Solved within a horizon from the moment on; None without cases."""
        return Proportion.of([case.steps is not None for case in self.cases]) if self.cases else None

    @property
    def failed_seeds(self) -> tuple[int, ...]:
        """Seeds of the cases that were not solved."""
        return tuple(case.seed for case in self.cases if case.steps is None)

    @property
    def without_label(self) -> int:
        """Number of unsolved cases that ended where the expert has no valid label."""
        return sum(case.steps is None and not case.labelled for case in self.cases)

    @property
    def mean_steps(self) -> float | None:
        """Mean over the solved cases, until they were [control steps]."""
        steps = [case.steps for case in self.cases if case.steps is not None]
        return float(np.mean(steps)) if steps else None

    @property
    def gaps(self) -> Gaps | None:
        """Gaps of the cost-to-go; None where no case has one."""
        gaps = [gap for case in self.cases if (gap := case.gap(self.horizon)) is not None]
        if not gaps:
            return None
        # A percentile that was seen, the one above where it falls between two.
        p95, p99 = (int(np.percentile(gaps, share, method="higher")) for share in (95, 99))
        return Gaps(float(np.mean(gaps)), p95, p99, max(gaps), len(self.failed_seeds))

    @property
    def above_largest(self) -> float | None:
        """Share of such draws that may exceed the largest gap seen, at 95 %; exact for independent draws."""
        return 1 - (1 - CONFIDENCE) ** (1 / len(self.cases)) if self.cases else None

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        success, gaps = self.success, self.gaps
        return {
            "group": self.group,
            "kind": self.name,
            "words": self.words,
            "n": len(self.cases),
            "left_out": self.left_out,
            "success_rate": success.rate if success else None,
            "interval": list(success.interval) if success else None,
            "without_label": self.without_label,
            "mean_steps": self.mean_steps,
            "gap": asdict(gaps) if gaps and self.group == "action" else None,
            "cases": [[case.seed, case.moment, case.steps, case.undisturbed] for case in self.cases],
        }


def pooled(rows: tuple[Row, ...], words: str) -> Row:
    """Return all cases of some rows of one group as one row. Raises `UsageError` without rows."""
    if not rows:
        raise UsageError(f"certificate: no rows to pool as {words!r}")
    cases = tuple(case for row in rows for case in row.cases)
    return Row(rows[0].group, "all", words, cases, rows[0].horizon, sum(row.left_out for row in rows))


@dataclass(frozen=True)
class Settings:
    """Settings of the runs. cases: of each kind; horizon: [control steps]; tolerance: to the goal [m]."""

    cases: int
    seed: int
    horizon: int
    control_hz: int
    tolerance: float
    success_steps: int


@dataclass(frozen=True)
class Certificate:
    """Recoverability of the expert on one robot and task, one row a kind.

    policy: from whose visited states the expert went on, too; None for none.
    """

    robot: str
    task: str
    policy: str | None
    fingerprint: Mapping[str, Any]
    settings: Settings
    rows: tuple[Row, ...]

    def of(self, group: Group) -> tuple[Row, ...]:
        """Return the rows of a group."""
        return tuple(row for row in self.rows if row.group == group)

    @property
    def states(self) -> Row:
        """All changed states."""
        return pooled(self.of("state"), "all changed states")

    @property
    def actions(self) -> Row:
        """All wrong actions: their `gaps.largest` is the empirical u of Ross et al. (2011)."""
        return pooled(self.of("action"), "all wrong actions")

    def to_json(self) -> dict[str, Any]:
        """Return the contents of `certificate.json`.

        robot, task, policy (or null), fingerprint, settings (`Settings`), confidence of every interval, mu (the largest
        gap of all wrong actions [control steps]), and rows, a list of: group (start, state, action, learner), kind,
        words, n, left_out, success_rate and interval (null without cases), without_label (failures in which the expert
        had no sound label at the end), mean_steps until solved, gap (`Gaps`; for wrong actions), and cases, each
        [seed, moment, steps or null, undisturbed or null].
        """
        gaps = self.actions.gaps
        rows = [*self.of("start"), *self.of("state"), self.states, *self.of("action"), self.actions]
        return {
            "robot": self.robot,
            "task": self.task,
            "policy": self.policy,
            "fingerprint": dict(self.fingerprint),
            "settings": asdict(self.settings),
            "confidence": CONFIDENCE,
            "mu": gaps.largest if gaps else None,
            "rows": [row.to_json() for row in [*rows, *self.of("learner")]],
        }

    def write(self, path: Path) -> None:
        """Write `path` whole or not at all, creating its folder."""
        write_json(path, self.to_json(), indent=None)


def summary_lines(certificate: Certificate) -> list[str]:
    """Return the table of recoveries, the table of wrong actions, and sentences on both, as plain lines."""
    settings, hz = certificate.settings, certificate.settings.control_hz
    horizon = f"{settings.horizon} steps ({_seconds(settings.horizon, hz)})"
    head = ("the expert continues from", f"solved in {horizon} [{CONFIDENCE:.0%}]", "mean steps", "cases", "left out")
    rows = [*certificate.of("start"), *certificate.of("state"), certificate.states, certificate.actions]
    costs_head = ("one wrong action costs, in steps", "mean", "95th", "99th", "largest", "never solved", "cases")
    costs = tuple(_costs(row, hz) for row in [*certificate.of("action"), certificate.actions])
    return [
        f"expert on {certificate.robot} {certificate.task}: {settings.cases} cases a kind, --seed={settings.seed}",
        "",
        *Table(head, tuple(map(_recovery, [*rows, *certificate.of("learner")]))).aligned_lines(),
        "",
        *Table(costs_head, costs).aligned_lines(),
        "",
        *_sentences(certificate),
    ]


def _recovery(row: Row) -> tuple[str, ...]:
    steps = _NONE if row.mean_steps is None else f"{row.mean_steps:.1f}"
    return (row.words, str(row.success or _NONE), steps, str(len(row.cases)), str(row.left_out))


def _costs(row: Row, hz: int) -> tuple[str, ...]:
    gaps = row.gaps
    if gaps is None:
        return (row.words, *[_NONE] * 5, "0")
    steps = (f"{gaps.mean:.1f}", *map(str, (gaps.p95, gaps.p99, gaps.largest)))
    costs = (f"{text} ({_seconds(float(text), hz)})" for text in steps)
    return (row.words, *costs, str(gaps.unrecovered), str(len(row.cases)))


def _sentences(certificate: Certificate) -> list[str]:
    lines = [_mu(certificate.actions, certificate.settings.control_hz)] if certificate.actions.cases else []
    for row in certificate.of("learner"):
        count = row.left_out + len(row.cases)
        lines.append(f"the policy had solved {row.left_out} of {count} before the expert's turn")
    return lines + [_failures(row) for row in certificate.rows if row.failed_seeds]


def _mu(actions: Row, hz: int) -> str:
    gaps = actions.gaps
    assert gaps is not None
    mu = f"mu (the u of Ross et al. 2011) is at least {gaps.largest} steps ({_seconds(gaps.largest, hz)})"
    if gaps.unrecovered:
        return f"{mu}, the whole horizon, as {gaps.unrecovered} of {len(actions.cases)} were never solved"
    return f"{mu}; with {CONFIDENCE:.0%} confidence, at most {actions.above_largest:.1%} of such actions cost more"


def _failures(row: Row) -> str:
    seeds = ", ".join(map(str, row.failed_seeds[:MAX_SEEDS])) + (", ..." if len(row.failed_seeds) > MAX_SEEDS else "")
    line = f"not solved, {row.words}: seeds {seeds}"
    if not row.without_label:
        return line
    return f"{line} ({row.without_label} of {len(row.failed_seeds)} ended where the expert has no valid label)"


def _seconds(steps: float, hz: int) -> str:
    return f"{steps / hz:.3g} s"
