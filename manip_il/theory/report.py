"""The page and the file of `manip-il theory`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.tables import Table
from manip_il.theory.bounds import DRAWS, ERROR, Curve
from manip_il.theory.figures import clouds_figure, errors_figure, linear_figure, theorem_figure
from manip_il.theory.linear import GUST, Drift
from manip_il.theory.problems import PROBLEMS, recoverability
from manip_il.theory.shift import WRONG, Shift

PAGE, FILE_NAME = "report.html", "theory.json"
_FITS = {"worst": "fitted", "even": "fitted, ties even", "constructed": "constructed"}


@dataclass(frozen=True)
class Theory:
    """All that was found. shift: of a run, where one was given."""

    curves: tuple[Curve, ...]
    drifts: tuple[Drift, ...]
    shift: Shift | None = None

    @property
    def above(self) -> int:
        """Number of policies whose gap is above its bound."""
        return sum(curve.above for curve in self.curves)

    @property
    def fitted(self) -> tuple[Curve, ...]:
        """The curves that the theorems speak of: fitted policies, the worst that their data leave open."""
        return tuple(curve for curve in self.curves if curve.fit == "worst")

    def to_json(self) -> dict[str, Any]:
        """Return everything for `theory.json`."""
        return {
            "curves": [curve.to_json() for curve in self.curves],
            "above": self.above,
            "drifts": [drift.to_json() for drift in self.drifts],
            "shift": None if self.shift is None else self.shift.to_json(),
        }


def slope_table(theory: Theory) -> Table:
    """Return the slopes of fitted policies, one row a process."""
    by = {(curve.problem, curve.learner): curve for curve in theory.fitted}
    rows = []
    for problem in PROBLEMS:
        horizons = by[problem.name, "cloning"].horizons
        u = recoverability(problem, horizons[-1])
        cells = [_slope(by[problem.name, learner]) for learner in ("cloning", "DAgger")]
        rows.append((problem.name, f"{u:g} at H = {horizons[-1]}", *(str(s) for s in problem.slopes), *cells))
    return Table(
        ("process", "recoverability u", "cloning, theorem", "DAgger, theorem", "cloning", "DAgger"), tuple(rows)
    )


def theory_report(theory: Theory, command: str, config: Mapping[str, Any], timings: Mapping[str, float]) -> Report:
    """Return the report of all that was found."""
    sections = [_theorems(theory), _numbers(theory), _linear(theory)]
    facts = [
        f"{sum(len(draws) for curve in theory.curves for draws in curve.losses):,} policies on three processes, every "
        f"value by dynamic programming: {theory.above or 'none'} above its bound.",
    ]
    if theory.shift is not None:
        sections = [*_arm(theory.shift), *sections]
        facts.append(_shift_fact(theory.shift))
    return Report(
        title="What is proved of imitation, seen",
        verdict=_verdict(theory),
        facts=tuple(facts),
        command=command,
        config=config,
        timings=timings,
        sections=tuple(sections),
    )


def _verdict(theory: Theory) -> str:
    by = {(curve.problem, curve.learner): curve.slope for curve in theory.fitted}
    first = PROBLEMS[0].name
    return (
        f"Where the expert mends a mistake, cloning's gap grows with the horizon to the power of "
        f"{by[first, 'cloning']:.1f} and DAgger's to the power of {by[first, 'DAgger']:.1f}; on a tightrope both to "
        f"{by['tightrope', 'DAgger']:.1f}."
    )


def _theorems(theory: Theory) -> Section:
    return Section(
        "Cloning and DAgger over the horizon",
        lead=(
            "Three finite processes, solved exactly, on which the expert always acts right. A wrong action "
            + "; ".join(f"{problem.words} ({problem.name})" for problem in PROBLEMS)
            + ".",
        ),
        formulas=(
            "Theorem 8.1, cloning:  J(π*) - J(π) ≤ H² ε,  ε: share of the expert's states in which π errs",
            "Theorem 8.2, DAgger:  J(π*) - J(π) ≤ u H ε,  ε: share of π's own states in which it errs",
        ),
        figures=(theorem_figure(theory.curves),),
        tables=(slope_table(theory),),
        notes=(
            "Slopes of gap over error in log-log, with 95 % bootstrap intervals over the draws of data. u is what one "
            "wrong step costs at most an expert who drives on. The chapter writes H ε and has u in its constant: where "
            "nothing mends a mistake, as on the tightrope, u is H, and DAgger pays as cloning does (Ross et al. 2011; "
            "Rajaraman et al. 2020).",
            f"Points: {DRAWS} fits a horizon to trajectories that leave about {ERROR:g}/H of the states unseen; there "
            "a fit takes the worst action that is left open, or (hollow) either evenly. Thick pale lines: policies "
            "that err with a given probability. Cloning with even ties finds back to the way by luck, on which "
            "the theorem does not count.",
        ),
    )


def _numbers(theory: Theory) -> Section:
    rows = [
        (
            f"{curve.problem}, {curve.learner}, {_FITS[curve.fit]}",
            _slope(curve),
            f"{curve.ratios[0]:.4g}",
            f"{curve.ratios[-1]:.4g}",
            f"{curve.largest_error:.2g}",
            str(curve.above),
        )
        for curve in theory.curves
    ]
    first, last = theory.curves[0].horizons[0], theory.curves[0].horizons[-1]
    columns = ("policy", "slope", f"gap / ε, H = {first}", f"H = {last}", "largest ε H", "above its bound")
    return Section("The numbers behind the points", tables=(Table(columns, tuple(rows)),))


def _linear(theory: Theory) -> Section:
    rows = [
        (
            f"{drift.system.size}, {drift.system.words}",
            f"{drift.system.pole:g}",
            f"{drift.noise:g}",
            f"{drift.error:.1e}",
            f"{drift.apart[-1]:.1e}",
            f"{drift.growth:.2f}" if drift.apart[-1] > GUST / 2 else "none",
        )
        for drift in theory.drifts
    ]
    columns = ("system", "open loop", "noise", "error in the expert's states", "distance at the end", "growth a step")
    return Section(
        "Continuous control: what becomes of an error",
        lead=(
            f"x' = A x + u + w, with gusts w of {GUST:g}; the expert halves every state. Its demonstrations hold "
            "little of what lies beside them, so there a clone does not correct: an error dies out where the open loop "
            "is stable, as under servos that hold joint targets, and grows by the open loop's factor a step where it "
            "is not, however small the clone's error in the expert's states.",
        ),
        figures=(linear_figure(theory.drifts),),
        tables=(Table(columns, tuple(rows)),),
        notes=(
            "Noise on the demonstrations (DART, dashed) shows the expert's corrections, and the clone learns them. For "
            "smooth deterministic imitators in general the exponential growth is proved (Simchowitz et al. 2025).",
        ),
    )


def _arm(shift: Shift) -> list[Section]:
    columns = (
        "policy",
        "success",
        "wrong, expert's states",
        "wrong, own states",
        "distance from data",
        "AUC (expert's)",
        "gap [steps]",
        "bound u H ε [steps]",
    )
    rows = [
        (
            "cloning (round 0)" if one.round == 0 else f"round {one.round}",
            str(one.success),
            "" if one.on_expert is None else format_percent(one.on_expert.rate),
            format_percent(one.on_own.rate),
            f"{one.distance:.2f}",
            f"{one.auc:.2f} ({one.auc_expert:.2f})",
            f"{shift.gap(one):.1f}",
            f"{shift.bound(one):,.0f}",
        )
        for one in shift.rounds
    ]
    return [
        Section(
            f"The arm: {shift.env.robot} {shift.env.task}",
            figures=(errors_figure(shift),),
            tables=(Table(columns, tuple(rows)),),
            notes=(
                f"An action is wrong if a joint is farther off the expert's label than {WRONG:g} of its largest step. "
                "Distance: of the states that the policy visits to the nearest in the data it was fitted on, median; 1 "
                "is that of the expert's own new episodes. AUC: of a classifier that tells its states from the data, "
                "in brackets the expert's; DAgger's data hold the mistakes of earlier rounds, too, so it is above 0.5.",
                f"Costs are control steps until solved, {shift.env.horizon} where it is not; the expert takes "
                f"{shift.expert_cost:.1f}. u is the most that one wrong action was seen to cost the expert: "
                f"{shift.u} steps, a lower bound. A bound above the horizon says nothing of this policy: the theorem "
                "counts every wrong action as the worst one.",
            ),
        ),
        Section(
            "Distribution shift: where the hand was",
            figures=(clouds_figure(shift),),
            notes=("Grey: the data that the policy was fitted on. Colour: where it took the hand itself.",),
        ),
    ]


def _shift_fact(shift: Shift) -> str:
    first, last = shift.rounds[0], shift.rounds[-1]
    words = "" if first.on_expert is None else f" against {format_percent(first.on_expert.rate)} in the expert's"
    return (
        f"On the arm, the cloned policy errs in {format_percent(first.on_own.rate)} of its own states{words}, "
        f"{first.distance:.1f} times as far from its data as the expert; round {last.round} errs in "
        f"{format_percent(last.on_own.rate)}, {last.distance:.1f} times as far."
    )


def _slope(curve: Curve) -> str:
    low, high = curve.interval
    return f"{curve.slope:.2f} [{low:.2f}, {high:.2f}]"


def summary_lines(theory: Theory) -> Sequence[str]:
    """Return the slopes as a table, and how many policies are above their bound, as plain lines."""
    return [*slope_table(theory).aligned_lines(), f"policies above their bound: {theory.above}"]
