"""`certificate.json`: the states from which the expert recovers, and the cost of one wrong action.

The cost of a state is the number of control steps until the task is solved. If Q*(s, a) is the expert's cost of going
on after action a in state s, and V*(s) its cost of acting itself, the gap Q*(s, a) - V*(s) is what the action a costs.
Ross, Gordon & Bagnell (2011, Theorem 2.2) bound imitation by the largest of them, u: a learner that errs in a share e
of the states it visits within T steps costs at most u T e more than the expert, so linearly in T if a mistake can be
undone, and not quadratically. Rajaraman et al. (2021) call it mu-recoverability. The largest gap among drawn actions,
as here, is a lower bound of u.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from manip_il.evaluation.figures import Bar, rates_figure
from manip_il.evaluation.intervals import CONFIDENCE, Proportion
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.results import write_json
from manip_il.evaluation.tables import BASELINE, CLONING, DAGGER, EXPERT, INTERVAL, Table

FILE_NAME = "certificate.json"
Group = Literal["start", "state", "action", "learner"]
_COLOURS: dict[Group, str] = {"start": EXPERT, "state": DAGGER, "action": CLONING, "learner": BASELINE}


@dataclass(frozen=True, slots=True)
class Case:
    """One episode. moment: the control step from which the expert is judged.

    steps: until solved from there [control steps]; None if not within a horizon. undisturbed: the same without the
    perturbation, if known. labelled: whether the expert's last label was valid.
    """

    seed: int
    moment: int
    steps: int | None
    undisturbed: int | None = None
    labelled: bool = True


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

    @property
    def success(self) -> Proportion | None:
        """Solved within a horizon from the moment on; None without cases."""
        return Proportion.of([case.steps is not None for case in self.cases]) if self.cases else None

    @property
    def counts(self) -> tuple[str, str]:
        """Cases, and episodes that were left out, as a table has them."""
        return str(len(self.cases)), str(self.left_out)

    @property
    def mean_steps(self) -> float | None:
        """Mean over the solved cases, until they were [control steps]."""
        steps = [case.steps for case in self.cases if case.steps is not None]
        return float(np.mean(steps)) if steps else None

    @property
    def every_gap(self) -> list[int]:
        """Q*(s, a) - V*(s) of each case [control steps]; the whole horizon if the expert did not recover."""
        known = [(case.steps, case.undisturbed) for case in self.cases if case.undisturbed is not None]
        return [self.horizon if steps is None else steps - undisturbed for steps, undisturbed in known]

    @property
    def gaps(self) -> Gaps | None:
        """Gaps of the cost-to-go; None if no case has one."""
        gaps = self.every_gap
        if not gaps:
            return None
        # A percentile that was seen, the one above if it falls between two.
        p95, p99 = (int(np.percentile(gaps, share, method="higher")) for share in (95, 99))
        unrecovered = sum(case.steps is None for case in self.cases)
        return Gaps(float(np.mean(gaps)), p95, p99, max(gaps), unrecovered)

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
            "without_label": sum(case.steps is None and not case.labelled for case in self.cases),
            "mean_steps": self.mean_steps,
            "gap": asdict(gaps) if gaps and self.group == "action" else None,
            "cases": [[case.seed, case.moment, case.steps, case.undisturbed] for case in self.cases],
        }


@dataclass(frozen=True)
class Certificate:
    """Recoverability of the expert on one robot and task, one row a kind.

    policy: from whose visited states the expert went on, too; None for none. settings: cases of each kind, seed,
    horizon [control steps], control_hz, tolerance [m] and success_steps of the runs.
    """

    robot: str
    task: str
    policy: str | None
    fingerprint: Mapping[str, Any]
    settings: Mapping[str, Any]
    rows: tuple[Row, ...]

    def of(self, group: Group) -> tuple[Row, ...]:
        """Return the rows of a group."""
        return tuple(row for row in self.rows if row.group == group)

    @property
    def states(self) -> Row:
        """All changed states."""
        return self._pooled("state", "all changed states")

    @property
    def actions(self) -> Row:
        """All wrong actions: their `gaps.largest` is the empirical u of Ross et al. (2011)."""
        return self._pooled("action", "all wrong actions")

    @property
    def pooled_rows(self) -> tuple[Row, ...]:
        """All rows; after those of changed states and of wrong actions, all of their cases as one."""
        parts = (*self.of("start"), *self.of("state"), self.states, *self.of("action"), self.actions)
        return (*parts, *self.of("learner"))

    def _pooled(self, group: Group, words: str) -> Row:
        rows = self.of(group)
        cases = tuple(case for row in rows for case in row.cases)
        return Row(group, "all", words, cases, self.settings["horizon"], sum(row.left_out for row in rows))

    def write(self, path: Path) -> None:
        """Write `certificate.json`, creating its folder.

        Of its keys mu is the largest gap of all wrong actions [control steps]; without_label of a row counts failures
        in which the expert had no sound label at the end; a case is [seed, moment, steps, undisturbed].
        """
        gaps, rows = self.actions.gaps, [row.to_json() for row in self.pooled_rows]
        content = {"robot": self.robot, "task": self.task, "policy": self.policy, "fingerprint": dict(self.fingerprint)}
        content |= {"settings": dict(self.settings), "confidence": CONFIDENCE, "mu": gaps.largest if gaps else None}
        write_json(path, content | {"rows": rows}, indent=None)

    def tables(self) -> tuple[Table, Table]:
        """Return the table of recoveries, and that of the costs of wrong actions."""
        head = ("the expert continues from", f"solved {INTERVAL}", "mean steps", "cases", "left out")
        cells = [
            (row.words, str(row.success or ""), f"{row.mean_steps:.1f}" if row.mean_steps else "", *row.counts)
            for row in self.pooled_rows
        ]
        recoveries = Table(head, tuple(cells), tuple(_COLOURS[row.group] for row in self.pooled_rows))
        costs: list[tuple[str, ...]] = []
        for row in [*self.of("action"), self.actions]:
            if gaps := row.gaps:
                seconds = map(self.in_seconds, (gaps.p95, gaps.p99, gaps.largest))
                costs.append((row.words, f"{gaps.mean:.1f}", *seconds, str(gaps.unrecovered), row.counts[0]))
        head = ("one wrong action costs, in steps", "mean", "95th", "99th", "largest", "never solved", "cases")
        return recoveries, Table(head, tuple(costs))

    def facts(self) -> list[str]:
        """Return sentences on the largest cost, and on the learner's states."""
        gaps, lines = self.actions.gaps, list[str]()
        if gaps is not None:
            whole = ", the whole horizon" if gaps.unrecovered else ""
            largest = self.in_seconds(gaps.largest)
            # exact for independent draws, none of which cost more
            above = 1 - (1 - CONFIDENCE) ** (1 / len(self.actions.cases))
            lines.append(
                f"mu (the u of Ross et al. 2011) is at least {largest}{whole}; with {CONFIDENCE:.0%} confidence, at "
                f"most {above:.1%} of such actions cost more."
            )
        for row in self.of("learner"):
            count = row.left_out + len(row.cases)
            lines.append(f"The policy had solved {row.left_out} of {count} before the expert's turn.")
        return lines

    def in_seconds(self, steps: int) -> str:
        """Return `100 steps (5 s)`."""
        return f"{steps} steps ({steps / self.settings['control_hz']:.3g} s)"


def certificate_report(certificate: Certificate, command: str, config: Mapping[str, Any]) -> Report:
    """Return the report of a certificate."""
    recoveries, costs = certificate.tables()
    name, states = f"{certificate.robot} {certificate.task}", certificate.states
    changed = f"{states.success} of {len(states.cases):,} changed states" if states.success else "no changed state"
    rows = [row for row in certificate.pooled_rows if row.name != "all"]
    bars = [Bar(row.words, (row.success,), _COLOURS[row.group]) for row in rows if row.success]
    horizon = certificate.in_seconds(certificate.settings["horizon"])
    note = (
        "An episode is perturbed once, at a step drawn from those of the undisturbed one; the expert then has "
        f"{horizon}. Left out: the perturbation changed nothing, or found no place."
    )
    cost_note = "The cost of an action: control steps until solved after it, less those of the undisturbed episode."
    return Report(
        title=f"Certificate of the expert: {name}",
        verdict=f"The expert on {name} recovers from {changed}.",
        facts=tuple(certificate.facts()),
        command=command,
        sections=(
            Section("Results", figures=(rates_figure(bars),), tables=(recoveries,), notes=(note,)),
            Section("What one wrong action costs", tables=(costs,), notes=(cost_note,)),
        ),
        config=config,
        fingerprint=certificate.fingerprint,
    )
