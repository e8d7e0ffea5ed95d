"""The page and the file of `manip-il theory`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from manip_il.evaluation.figures import ARMS, CLONING, DAGGER, SOFT, Figure, drawing, to_figure
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.tables import Table
from manip_il.theory.bounds import DRAWS, ERROR, Curve
from manip_il.theory.linear import GUST, OPEN_LOOPS, Drift
from manip_il.theory.processes import PROCESSES
from manip_il.theory.shift import WRONG, RoundShift, Shift

FILE_NAME = "theory.json"
_LOOKS = {"cloning": (CLONING, "o"), "DAgger": (DAGGER, "s")}
_LEAST = 1e-7  # of a distance on a logarithmic axis
_CLOUDS, _POINTS = 5, 1_500  # rounds whose clouds are shown, and points of a cloud
_DATA = "#b9bfc6"


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
    def by_name(self) -> dict[tuple[str, str], Curve]:
        """The curves by process and learner."""
        return {(curve.problem, curve.learner): curve for curve in self.curves}

    def to_json(self) -> dict[str, Any]:
        """Return everything for `theory.json`."""
        return {
            "curves": [curve.to_json() for curve in self.curves],
            "above": self.above,
            "drifts": [drift.to_json() for drift in self.drifts],
            "shift": None if self.shift is None else self.shift.to_json(),
        }


def slope_table(theory: Theory) -> Table:
    """Return the slopes, one row a process."""
    rows = []
    for process in PROCESSES:
        cloned, improved = (theory.by_name[process.name, learner] for learner in ("cloning", "DAgger"))
        last = cloned.horizons[-1]
        u = f"{process.recoverability(last):g} at H = {last}"
        rows.append((process.name, u, *map(str, process.slopes), _slope(cloned), _slope(improved)))
    return Table(
        ("process", "recoverability u", "cloning, theorem", "DAgger, theorem", "cloning", "DAgger"), tuple(rows)
    )


def theory_report(theory: Theory, command: str, config: Mapping[str, Any]) -> Report:
    """Return the report of all that was found."""
    sections = [_theorems(theory), _linear(theory)]
    facts = [
        f"{sum(curve.gaps.size for curve in theory.curves):,} policies on three processes, every value by dynamic "
        f"programming: {theory.above or 'none'} above its bound.",
    ]
    if theory.shift is not None:
        sections = [*_arm(theory.shift), *sections]
    slopes = {key: curve.slope for key, curve in theory.by_name.items()}
    walk, rope = PROCESSES[0].name, PROCESSES[1].name
    return Report(
        title="What is proved of imitation, seen",
        verdict="Where the expert mends a mistake, cloning's gap grows with the horizon to the power of "
        f"{slopes[walk, 'cloning']:.1f} and DAgger's to the power of {slopes[walk, 'DAgger']:.1f}; on a {rope} both to "
        f"{slopes[rope, 'DAgger']:.1f}.",
        facts=tuple(facts),
        command=command,
        config=config,
        sections=tuple(sections),
    )


def _slope(curve: Curve) -> str:
    return "{:.2f} [{:.2f}, {:.2f}]".format(curve.slope, *curve.interval)


def _theorems(theory: Theory) -> Section:
    return Section(
        "Cloning and DAgger over the horizon",
        lead=(
            "Three finite processes, solved exactly, on which the expert always acts right. A wrong action "
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
            "Slopes of gap over error in log-log, with 95 % bootstrap intervals over the draws of data. u is what one "
            "wrong step costs at most an expert who drives on. The chapter writes H ε and has u in its constant: where "
            "nothing mends a mistake, as on the tightrope, u is H, and DAgger pays as cloning does (Ross et al. 2011; "
            "Rajaraman et al. 2020).",
            f"Points: {DRAWS} fits a horizon to trajectories that leave about {ERROR:g}/H of the states unseen; there "
            "a fit takes the worst action that is left open.",
        ),
    )


def _theorem_figure(curves: Sequence[Curve]) -> Figure:
    """Gap over error against the horizon: one panel a process, both learners, beside their bounds."""
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
    columns = ("system", "open loop", "noise", "error in the expert's states", "distance at the end", "growth a step")
    return Section(
        "Continuous control: what becomes of an error",
        lead=(
            f"x' = a x + u + w, with gusts w of {GUST:g}; the expert halves every state. Its demonstrations hold "
            "little of what lies beside them, so there a clone does not correct: an error dies out where the open loop "
            "is stable, as under servos that hold joint targets, and grows by the open loop's factor a step where it "
            "is not, however small the clone's error in the expert's states.",
        ),
        figures=(_linear_figure(theory.drifts),),
        tables=(Table(columns, tuple(rows)),),
        notes=(
            "Noise on the demonstrations (DART, dashed) shows the expert's corrections, and the clone learns them. For "
            "smooth deterministic imitators in general the exponential growth is proved (Simchowitz et al. 2025).",
        ),
    )


def _linear_figure(drifts: Sequence[Drift]) -> Figure:
    """How far clones get from the expert, step by step."""
    with drawing(1, size=(5.4, 3.4)) as (drawn, axes):
        axis, poles = axes[0, 0], list(OPEN_LOOPS)
        for drift in drifts:
            words = f"{OPEN_LOOPS[drift.pole]}, open loop {drift.pole:g}"
            label = words + (", noisy demonstrations" if drift.noise else "")
            look = {"color": ARMS[poles.index(drift.pole)], "ls": "--" if drift.noise else "-"}
            axis.plot(range(1, len(drift.apart) + 1), np.maximum(drift.apart, _LEAST), lw=1.6, label=label, **look)
        axis.axhline(GUST, color=SOFT, lw=0.8, ls=":")
        axis.set(yscale="log", xlabel="step", ylabel="distance from the expert", ylim=(_LEAST, 100))
        drawn.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=2)
        return to_figure(drawn, "Distance of clones from the expert over the steps, of stable and unstable systems")


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
                f"An action is wrong if a joint is farther off the expert's label than {WRONG:g} of its largest step. "
                "Distance: of the states that the policy visits to the nearest in the data it was fitted on, median; 1 "
                "is that of the expert's own new episodes.",
                f"Costs are control steps until solved, {shift.env.horizon} where it is not; the expert takes "
                f"{shift.expert_cost:.1f}. u is the most that one wrong action was seen to cost the expert: "
                f"{shift.u} steps, a lower bound. A bound above the horizon says nothing of this policy: the theorem "
                "counts every wrong action as the worst one.",
            ),
        ),
        Section(
            "Distribution shift: where the hand was",
            figures=(_clouds_figure(shift.rounds),),
            notes=("Grey: the data that the policy was fitted on. Colour: where it took the hand itself.",),
        ),
    ]


def _clouds_figure(rounds: Sequence[RoundShift]) -> Figure:
    """Where the hand was, in the data and when the policy drove: from above and from the side, by round."""
    if len(rounds) > _CLOUDS:  # the first ones closest together: there most changes
        rounds = [rounds[index] for index in (0, 1, 2, (len(rounds) + 2) // 2, len(rounds) - 1)]
    with drawing(len(rounds), 2, size=(9.0 / len(rounds), 2.2), share=True) as (drawn, axes):
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
        return to_figure(drawn, "Places of the hand in the data and in the policy's rollouts, by round")
