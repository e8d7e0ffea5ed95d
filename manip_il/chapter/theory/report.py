"""The report and the JSON file of `manip-il theory`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from manip_il.chapter.theory.bounds import DRAWS, ERROR, PROCESSES, LossCurve
from manip_il.chapter.theory.linear import CHUNK, GUST, REMEDIES, SYSTEMS, Drift
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
                "Theorem 8.1, cloning:  |V(π*) - V(π)| ≤ H² ε,  ε: expected share of the H steps"
                " of the expert's trajectories in which π errs (Eq. 8.5)"
            ),
            (
                "Theorem 8.2, DAgger:  |V(π*) - V(π)| ≤ H ε  after Õ(H²) rounds, with high"
                " probability,  ε: the error of the fits"
            ),
            "Measured for DAgger:  V(π*) - V(π) ≤ u H ε,  ε: the same on π's own trajectories",
        ),
        figures=(_theorem_figure(theory.curves),),
        tables=(slope_table(theory),),
        notes=(
            (
                "Log-log slopes of gap over error. u is the largest cost of one wrong step if the"
                " expert then drives (Ross et al. 2011). H ε is the case u ≤ 1. If no recovery is"
                " possible, as on the tightrope, u is H, and DAgger loses as much as cloning"
                " (Rajaraman et al. 2020). The bound has no absolute value: a policy may beat an"
                " expert that is not optimal by more."
            ),
            (
                "On the tightrope the fits reach about half of the bound, as they err in all"
                " steps. A policy that errs in the first step alone reaches it."
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
                f"x' = A x + u + w, with disturbances w of {GUST:g}; the expert halves the state in"
                " every step. A clone corrects only the deviations that its demonstrations show. If"
                " it corrects none, an error develops as in the open loop: it decays if that is"
                " stable. A stable open loop does not make a clone safe: in the coupled system the"
                " open loop and the expert are stable, but the clone, which has learnt a part of"
                " the expert's feedback, is not, however small its error in the expert's states"
                " (in the legend)."
            ),
        ),
        figures=(_linear_figure(theory.drifts),),
        notes=(
            (
                "For smooth, deterministic, Markovian imitators such growth cannot be excluded by"
                " any method that has expert data alone, even if the dynamics are exponentially"
                " stable, unless the data is sufficiently spread (Simchowitz et al. 2025)."
            ),
            (
                f"Chunks of {CHUNK} actions, executed without feedback, prevent it if the open loop"
                " is stable; otherwise noise on the demonstrations (DART) makes the expert show"
                " the missing corrections (Zhang et al. 2025)."
            ),
        ),
    )


def _linear_figure(drifts: Sequence[Drift]) -> Figure:
    """Distance of clones from the expert over the steps: one panel per system."""
    with drawing(len(SYSTEMS), size=(3.2, 3.4)) as (drawn, axes):
        for drift, axis in zip(drifts, np.repeat(axes[0], len(REMEDIES)), strict=True):
            label = f"{drift.remedy}: {drift.error:.0e}, {drift.apart[-1]:.0e}"
            colour = COLOURS[REMEDIES.index(drift.remedy)]
            axis.plot(range(1, len(drift.apart) + 1), drift.apart, color=colour, label=label)
            title = f"{drift.system}, largest eigenvalue {drift.radius:.2f}"
            axis.set(yscale="log", xlabel="step", title=title, ylim=_RANGE)
        for axis in axes[0]:
            axis.axhline(GUST, color=SOFT, ls=":")
            axis.legend(title="remedy: error, last distance")
        axes[0, 0].set_ylabel("distance from the expert")
        return to_figure(
            drawn,
            "Distance of clones from the expert over the steps, on stable and unstable systems",
        )


def _arm(shift: Shift) -> list[Section]:
    columns = (
        *("policy", "success", "wrong, expert's states", "wrong, own states"),
        *("ε, expert's", "ε, own", "gap [steps]", "H² ε [steps]", "u H ε [steps]"),
    )
    rows = [
        (
            one.name,
            str(one.success),
            *("" if value is None else format_percent(value) for value in one.shares),
            *("" if value is None else f"{value:.4f}" for value in one.errors),
            f"{one.gap:.1f}",
            *("" if value is None else f"{value:,.0f}" for value in one.bounds),
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
                    f" {WRONG:g} of its largest step. ε is the number of wrong actions in an"
                    f" episode divided by H = {shift.env.horizon} (Eq. 8.5): episodes end with"
                    " success, and no action after it is wrong."
                ),
                (
                    "The reward is 1 in every control step after success, so that V is H less the"
                    f" control steps until success; the expert takes {shift.expert_cost:.1f}. u is"
                    " the largest observed cost of one wrong action for the expert,"
                    f" {shift.u} steps; the true u may be larger. A bound above the horizon says"
                    " nothing about this policy: the theorem counts every wrong action as the"
                    " worst one."
                ),
            ),
        ),
    ]
