"""The report and the JSON file of `manip-il theory`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from manip_il.chapter.theory.bounds import DRAWS, ERROR, PROCESSES, LossCurve
from manip_il.chapter.theory.linear import GUST, OPEN_LOOPS, Drift
from manip_il.chapter.theory.shift import WRONG, RoundShift, Shift
from manip_il.evaluation.figures import CLONING, COLOURS, DAGGER, SOFT, Figure, drawing, to_figure
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.tables import Table

FILE_NAME = "theory.json"
_LOOKS = {"cloning": (CLONING, "o"), "DAgger": (DAGGER, "s")}
_LEAST = 1e-7  # smallest distance on the logarithmic axis
_CLOUDS, _POINTS = 5, 1_500  # most rounds shown as clouds, and most points per cloud
_DATA = "#b9bfc6"


@dataclass(frozen=True)
class Theory:
    """All results. shift: a run's distribution shift, if a run was given."""

    curves: tuple[LossCurve, ...]
    drifts: tuple[Drift, ...]
    shift: Shift | None = None

    @property
    def above(self) -> int:
        """Number of policies whose gap exceeds its bound."""
        return sum(curve.above for curve in self.curves)

    @property
    def by_name(self) -> dict[tuple[str, str], LossCurve]:
        """Curves by process and learner."""
        return {(curve.problem, curve.learner): curve for curve in self.curves}

    def to_json(self) -> dict[str, Any]:
        """Return the content of `theory.json`."""
        return {
            "curves": [curve.to_json() for curve in self.curves],
            "above": self.above,
            "drifts": [drift.to_json() for drift in self.drifts],
            "shift": None if self.shift is None else self.shift.to_json(),
        }


def slope_table(theory: Theory) -> Table:
    """Return a table of the log-log slopes of gap over error against the horizon, one row per process."""
    rows = []
    for process in PROCESSES:
        cloned, improved = (theory.by_name[process.name, learner] for learner in ("cloning", "DAgger"))
        last = cloned.horizons[-1]
        u = f"{process.recoverability(last):g} at H = {last}"
        rows.append((process.name, u, *map(str, process.slopes), _slope(cloned), _slope(improved)))
    return Table(
        ("process", "recoverability u", "cloning, theorem", "DAgger, theorem", "cloning", "DAgger"), tuple(rows)
    )


def theory_report(theory: Theory) -> Report:
    """Return the report of all results."""
    sections = [_theorems(theory), _linear(theory)]
    facts = [
        f"{sum(curve.gaps.size for curve in theory.curves):,} policies on three processes, all values by dynamic "
        f"programming: {theory.above or 'none'} above its bound.",
    ]
    if theory.shift is not None:
        sections = [*_arm(theory.shift), *sections]
    slopes = {key: curve.slope for key, curve in theory.by_name.items()}
    walk, rope = PROCESSES[0].name, PROCESSES[1].name
    return Report(
        title="Theorems on imitation, compared with measurements",
        verdict="If the expert can recover from a mistake, cloning's gap per error grows as the horizon to the power "
        f"of {slopes[walk, 'cloning']:.1f} and DAgger's to the power of {slopes[walk, 'DAgger']:.1f}; on a {rope} "
        f"both powers are {slopes[rope, 'DAgger']:.1f}.",
        facts=tuple(facts),
        sections=tuple(sections),
    )


def _slope(curve: LossCurve) -> str:
    return "{:.2f} [{:.2f}, {:.2f}]".format(curve.slope, *curve.interval)


def _theorems(theory: Theory) -> Section:
    return Section(
        "Cloning and DAgger over the horizon",
        lead=(
            "Three finite processes, solved exactly, on which the expert never errs. A wrong action "
            + "; ".join(f"{process.words} ({process.name})" for process in PROCESSES)
            + ".",
        ),
        formulas=(
            "Theorem 8.1, cloning:  J(π*) - J(π) ≤ H² ε,  ε: share of the expert's states in which π errs",
            "Theorem 8.2, DAgger:  J(π*) - J(π) ≤ u H ε,  ε: share of π's own states in which it errs",
        ),
        figures=(_theorem_figure(theory.curves),),
        tables=(slope_table(theory),),
        notes=(
            "Log-log slopes of gap over error, with 95 % bootstrap intervals over the draws of data. u is the largest "
            "cost of one wrong step if the expert then drives. Where the bound is stated as H ε, its constant includes "
            "u: if no recovery is possible, as on the tightrope, u is H, and DAgger loses as much as cloning (Ross et "
            "al. 2011; Rajaraman et al. 2020).",
            f"Points: {DRAWS} fits per horizon, to trajectories that leave about {ERROR:g}/H of the states unseen; in "
            "those, a fit takes the worst action.",
        ),
    )


def _theorem_figure(curves: Sequence[LossCurve]) -> Figure:
    """Gap over error against the horizon: one panel per process, with both learners and their bounds."""
    with drawing(len(PROCESSES), size=(3.2, 3.0)) as (drawn, axes):
        for axis, process in zip(axes[0], PROCESSES, strict=True):
            own = [curve for curve in curves if curve.problem == process.name]
            horizons = np.array(own[0].horizons)
            u = [process.recoverability(int(horizon)) for horizon in horizons]
            axis.plot(horizons, horizons**2.0, ":", color=CLONING, lw=1.2, label="bound 8.1: H²")
            axis.plot(horizons, horizons * u, ":", color=DAGGER, lw=1.2, label="bound 8.2: u H")
            for curve in own:
                colour, marker = _LOOKS[curve.learner]
                axis.plot(horizons, curve.ratios, marker, color=colour, ms=4.5, label=curve.learner)
            axis.set(xscale="log", yscale="log", xlabel="horizon H", title=process.name)
            axis.set_xticks([10, 40, 160, 640], ["10", "40", "160", "640"])
            axis.minorticks_off()
        axes[0, 0].set_ylabel("gap / ε")
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        return to_figure(drawn, "Gap over error against the horizon, three processes, cloning and DAgger, with bounds")


def _linear(theory: Theory) -> Section:
    rows = [
        (
            OPEN_LOOPS[drift.pole],
            f"{drift.pole:g}",
            f"{drift.noise:g}",
            f"{drift.error:.1e}",
            f"{drift.apart[-1]:.1e}",
            f"{drift.growth:.2f}" if drift.apart[-1] > GUST / 2 else "none",
        )
        for drift in theory.drifts
    ]
    columns = ("system", "open loop", "noise", "error in the expert's states", "final distance", "growth per step")
    return Section(
        "Continuous control: how an error develops",
        lead=(
            f"x' = a x + u + w, with disturbances w of {GUST:g}; the expert halves the state in every step. Its "
            "demonstrations cover few states beside its path, so a clone does not correct errors there: they decay if "
            "the open loop is stable, as with servos that hold joint targets, and otherwise grow by the open loop's "
            "factor per step, however small the clone's error in the expert's states.",
        ),
        figures=(_linear_figure(theory.drifts),),
        tables=(Table(columns, tuple(rows)),),
        notes=(
            "Noise on the demonstrations (DART, dashed) makes the expert show corrections, and the clone learns them. "
            "The exponential growth is proved for smooth deterministic imitators (Simchowitz et al. 2025).",
        ),
    )


def _linear_figure(drifts: Sequence[Drift]) -> Figure:
    """Distance of clones from the expert over the steps."""
    with drawing(1, size=(5.4, 3.4)) as (drawn, axes):
        axis, poles = axes[0, 0], list(OPEN_LOOPS)
        for drift in drifts:
            words = f"{OPEN_LOOPS[drift.pole]}, open loop {drift.pole:g}"
            label = words + (", noisy demonstrations" if drift.noise else "")
            look = {"color": COLOURS[poles.index(drift.pole)], "ls": "--" if drift.noise else "-"}
            axis.plot(range(1, len(drift.apart) + 1), np.maximum(drift.apart, _LEAST), lw=1.6, label=label, **look)
        axis.axhline(GUST, color=SOFT, lw=0.8, ls=":")
        axis.set(yscale="log", xlabel="step", ylabel="distance from the expert", ylim=(_LEAST, 100))
        drawn.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=2)
        return to_figure(drawn, "Distance of clones from the expert over the steps, on stable and unstable systems")


def _arm(shift: Shift) -> list[Section]:
    columns = (
        *("policy", "success", "wrong, expert's states", "wrong, own states", "distance from data"),
        *("gap [steps]", "bound u H ε [steps]"),
    )
    rows = [
        (
            one.name,
            str(one.success),
            "" if one.on_expert is None else format_percent(one.on_expert),
            format_percent(one.on_own),
            f"{one.distance:.2f}",
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
                f"An action is wrong if a joint is off the expert's label by more than {WRONG:g} of its largest step. "
                "Distance: median distance of the policy's states to the nearest training state, relative to that of "
                "the expert's states in new episodes.",
                f"Costs are control steps until success, or {shift.env.horizon} without success; the expert takes "
                f"{shift.expert_cost:.1f}. u is the largest observed cost of one wrong action for the expert, "
                f"{shift.u} steps; the true u may be larger. A bound above the horizon says nothing about this policy: "
                "the theorem counts every wrong action as the worst one.",
            ),
        ),
        Section(
            "Distribution shift: positions of the hand",
            figures=(_clouds_figure(shift.rounds),),
            notes=("Grey: the policy's training data. Colour: the policy's own rollouts.",),
        ),
    ]


def _clouds_figure(rounds: Sequence[RoundShift]) -> Figure:
    """Positions of the hand in the data and in the policy's rollouts, from above and from the side, by round."""
    if len(rounds) > _CLOUDS:  # mostly early rounds, which differ most
        rounds = [rounds[index] for index in (0, 1, 2, (len(rounds) + 2) // 2, len(rounds) - 1)]
    with drawing(len(rounds), 2, size=(9.0 / len(rounds), 2.2), sharex="row", sharey="row") as (drawn, axes):
        for column, one in enumerate(rounds):
            for row, across in enumerate(((1, 0), (0, 2))):
                axis = axes[row, column]
                for places, colour in ((one.data, _DATA), (one.hand, CLONING if one.round == 0 else DAGGER)):
                    shown = places[:: max(1, len(places) // _POINTS)]
                    axis.scatter(*shown[:, across].T, s=2.5, color=colour, alpha=0.55, lw=0, rasterized=True)
                axis.set_aspect("equal", adjustable="box")
                axis.tick_params(labelsize=7.5)
            axes[0, column].set_title(one.name, fontsize=9.5)
        axes[0, 0].invert_xaxis()
        axes[0, 0].set_ylabel("from above: x over y [m]", fontsize=8.5)
        axes[1, 0].set_ylabel("from the side: z over x [m]", fontsize=8.5)
        return to_figure(drawn, "Positions of the hand in the data and in the policy's rollouts, by round")
