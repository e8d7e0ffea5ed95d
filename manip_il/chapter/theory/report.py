"""The report and the JSON file of `manip-il theory`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from manip_il.chapter.theory.bounds import DRAWS, ERROR, PROCESSES, LossCurve
from manip_il.chapter.theory.linear import GUST, OPEN_LOOPS, Drift
from manip_il.chapter.theory.shift import WRONG, Shift
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.report import (
    CLONING,
    COLOURS,
    DAGGER,
    SOFT,
    Figure,
    Report,
    Section,
    Table,
    drawing,
    to_figure,
)

FILE_NAME = "theory.json"
_LOOKS = {"cloning": (CLONING, "o"), "DAgger": (DAGGER, "s")}
_RANGE = (1e-7, 100)  # of the distances on the logarithmic axis


@dataclass(frozen=True)
class Theory:
    """All results.

    Attributes:
        curves: Loss curves of cloning and of DAgger on each of `PROCESSES`, in turn.
        drifts: Drifts of clones on linear systems.
        shift: A run's distribution shift, if a run was given.
    """

    curves: tuple[LossCurve, ...]
    drifts: tuple[Drift, ...]
    shift: Shift | None = None

    @property
    def above(self) -> int:
        """Number of policies whose gap exceeds its bound."""
        return sum(curve.above for curve in self.curves)

    def to_json(self) -> dict[str, Any]:
        """Return the content of `theory.json`."""
        return {
            "curves": [curve.to_json() for curve in self.curves],
            "above": self.above,
            "drifts": [drift.to_json() for drift in self.drifts],
            "shift": None if self.shift is None else self.shift.to_json(),
        }


def slope_table(theory: Theory) -> Table:
    """Return a table of the log-log slopes of gap over error against the horizon, one row per
    process.
    """
    rows = []
    for process, *own in zip(PROCESSES, theory.curves[::2], theory.curves[1::2], strict=True):
        last = own[0].horizons[-1]
        u = f"{process.recoverability(last):g} at H = {last}"
        slopes = (f"{curve.slope:.2f}" for curve in own)
        rows.append((process.name, u, *map(str, process.slopes), *slopes))
    return Table(
        ("process", "recoverability u", "cloning, theorem", "DAgger, theorem", "cloning", "DAgger"),
        tuple(rows),
    )


def theory_report(theory: Theory) -> Report:
    """Return the report of all results."""
    sections = [_theorems(theory), _linear(theory)]
    if theory.shift is not None:
        sections = [*_arm(theory.shift), *sections]
    walk, improved, _, rope, *_ = (curve.slope for curve in theory.curves)
    policies = sum(curve.gaps.size for curve in theory.curves)
    return Report(
        title="Theorems on imitation, compared with measurements",
        verdict=(
            "If the expert can recover from a mistake, cloning's gap per error grows as the"
            f" horizon to the power of {walk:.1f} and DAgger's to the power of {improved:.1f}; on a"
            f" tightrope both powers are {rope:.1f}."
        ),
        facts=(
            (
                f"{policies:,} policies on three processes, all values by dynamic programming: "
                f"{theory.above or 'none'} above its bound."
            ),
        ),
        sections=tuple(sections),
    )


def _theorems(theory: Theory) -> Section:
    return Section(
        "Cloning and DAgger over the horizon",
        lead=(
            "Three finite processes, solved exactly, on which the expert never errs. A wrong"
            " action "
            + "; ".join(f"{process.words} ({process.name})" for process in PROCESSES)
            + ".",
        ),
        formulas=(
            (
                "Theorem 8.1, cloning:  J(π*) - J(π) ≤ H² ε,  ε: share of the expert's states in"
                " which π errs"
            ),
            (
                "Theorem 8.2, DAgger:  J(π*) - J(π) ≤ u H ε,  ε: share of π's own states in which"
                " it errs"
            ),
        ),
        figures=(_theorem_figure(theory.curves),),
        tables=(slope_table(theory),),
        notes=(
            (
                "Log-log slopes of gap over error. u is the largest cost of one wrong step if the"
                " expert then drives. Where the bound is stated as H ε, its constant includes u: if"
                " no recovery is possible, as on the tightrope, u is H, and DAgger loses as much as"
                " cloning (Ross et al. 2011; Rajaraman et al. 2020)."
            ),
            (
                f"Points: {DRAWS} fits per horizon, to trajectories that leave about {ERROR:g}/H of"
                " the states unseen; in those, a fit takes the worst action."
            ),
        ),
    )


def _theorem_figure(curves: Sequence[LossCurve]) -> Figure:
    """Gap over error against the horizon: one panel per process, with both learners and their
    bounds.
    """
    with drawing(len(PROCESSES), size=(3.2, 3.0)) as (drawn, axes):
        for curve, axis in zip(curves, np.repeat(axes[0], 2), strict=True):
            colour, marker = _LOOKS[curve.learner]
            bounds = curve.bounds.mean(axis=1) / curve.errors.mean(axis=1)
            axis.plot(curve.horizons, curve.ratios, marker, color=colour, label=curve.learner)
            axis.plot(curve.horizons, bounds, ":", color=colour, label=f"bound, {curve.learner}")
            axis.set(xscale="log", yscale="log", xlabel="horizon H", title=curve.problem)
        axes[0, 0].set_ylabel("gap / ε")
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        return to_figure(
            drawn,
            "Gap over error against the horizon, three processes, cloning and DAgger, with bounds",
        )


def _linear(theory: Theory) -> Section:
    return Section(
        "Continuous control: how an error develops",
        lead=(
            (
                f"x' = a x + u + w, with disturbances w of {GUST:g}; the expert halves the state in"
                " every step. Its demonstrations cover few states beside its path, so a clone does"
                " not correct errors there: they decay if the open loop is stable, as with servos"
                " that hold joint targets, and otherwise grow by the open loop's factor per step,"
                " however small the clone's error in the expert's states (in the legend)."
            ),
        ),
        figures=(_linear_figure(theory.drifts),),
        notes=(
            (
                "Noise on the demonstrations (DART, dashed) makes the expert show corrections, and"
                " the clone learns them. The exponential growth is proved for smooth deterministic"
                " imitators (Simchowitz et al. 2025)."
            ),
        ),
    )


def _linear_figure(drifts: Sequence[Drift]) -> Figure:
    """Distance of clones from the expert over the steps."""
    with drawing(1, size=(5.4, 4.4)) as (drawn, axes):
        [[axis]] = axes
        for drift in drifts:
            label = (
                f"{OPEN_LOOPS[drift.pole]}, a = {drift.pole:g}{', noisy' if drift.noise else ''}:"
                f" error {drift.error:.1e}, growth {drift.growth:.2f}"
            )
            colour = COLOURS[list(OPEN_LOOPS).index(drift.pole)]
            steps, line = range(1, len(drift.apart) + 1), "--" if drift.noise else "-"
            axis.plot(steps, drift.apart, line, color=colour, label=label)
        axis.axhline(GUST, color=SOFT, ls=":")
        axis.set(yscale="log", xlabel="step", ylabel="distance from the expert", ylim=_RANGE)
        drawn.legend(*axis.get_legend_handles_labels(), loc="outside lower center")
        return to_figure(
            drawn,
            "Distance of clones from the expert over the steps, on stable and unstable systems",
        )


def _arm(shift: Shift) -> list[Section]:
    columns = (
        *("policy", "success", "wrong, expert's states", "wrong, own states"),
        *("gap [steps]", "bound u H ε [steps]"),
    )
    rows = [
        (
            one.name,
            str(one.success),
            "" if one.on_expert is None else format_percent(one.on_expert),
            format_percent(one.on_own),
            f"{one.gap:.1f}",
            f"{one.bound:,.0f}",
        )
        for one in shift.rounds
    ]
    return [
        Section(
            f"The arm: {shift.env.robot} {shift.env.task}",
            tables=(Table(columns, tuple(rows)),),
            notes=(
                (
                    "An action is wrong if a joint is off the expert's label by more than"
                    f" {WRONG:g} of its largest step."
                ),
                (
                    f"Costs are control steps until success, or {shift.env.horizon} without"
                    f" success; the expert takes {shift.expert_cost:.1f}. u is the largest observed"
                    f" cost of one wrong action for the expert, {shift.u} steps; the true u may be"
                    " larger. A bound above the horizon says nothing about this policy: the"
                    " theorem counts every wrong action as the worst one."
                ),
            ),
        ),
    ]
