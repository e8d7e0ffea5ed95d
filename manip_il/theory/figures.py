"""Figures of the theory's report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from manip_il.evaluation.figures import ARMS, CLONING, DAGGER, SOFT, Figure, drawing, to_figure
from manip_il.theory.bounds import Curve
from manip_il.theory.linear import GUST, SYSTEMS, Drift
from manip_il.theory.problems import PROBLEMS, recoverability
from manip_il.theory.shift import RoundShift, Shift

_LOOKS = {"cloning": (CLONING, "o"), "DAgger": (DAGGER, "s")}
_LEAST = 1e-7  # of a distance on a logarithmic axis
MOST_CLOUDS = 5  # rounds whose clouds are shown
_POINTS = 1_500  # of a cloud
_DATA = "#b9bfc6"


def theorem_figure(curves: Sequence[Curve]) -> Figure:
    """Draw gap over error against the horizon: one panel a process, both learners, beside their bounds."""
    with drawing(len(PROBLEMS), size=(3.2, 3.0)) as (drawn, axes):
        for axis, problem in zip(axes[0], PROBLEMS, strict=True):
            own = [curve for curve in curves if curve.problem == problem.name]
            horizons = np.array(own[0].horizons)
            u = [recoverability(problem, int(horizon)) for horizon in horizons]
            axis.plot(horizons, horizons**2.0, ":", color=CLONING, lw=1.2, label="bound 8.1: H²")
            axis.plot(horizons, horizons * u, ":", color=DAGGER, lw=1.2, label="bound 8.2: u H")
            for curve in own:
                colour, marker = _LOOKS[curve.learner]
                if curve.fit == "constructed":
                    axis.plot(horizons, curve.ratios, "-", color=colour, lw=4, alpha=0.2)
                else:
                    filled = colour if curve.fit == "worst" else "white"
                    label = curve.learner if curve.fit == "worst" else f"{curve.learner}, ties even"
                    axis.plot(
                        horizons,
                        curve.ratios,
                        marker,
                        color=colour,
                        markerfacecolor=filled,
                        markersize=4.5,
                        label=label,
                    )
            axis.set(xscale="log", yscale="log", xlabel="horizon H", title=problem.name)
            axis.set_xticks([10, 40, 160, 640], ["10", "40", "160", "640"])
            axis.minorticks_off()
        axes[0, 0].set_ylabel("gap / ε")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside lower center", ncols=3)
        return to_figure(drawn, "Gap over error against the horizon, three processes, cloning and DAgger, with bounds")


def linear_figure(drifts: Sequence[Drift]) -> Figure:
    """Draw how far clones get from the expert, step by step: one panel a size of system."""
    sizes = list(dict.fromkeys(system.size for system in SYSTEMS))
    poles = sorted({system.pole for system in SYSTEMS})
    titles = {"scalar": "one dimension", "plane": "two, demonstrations on a line"}
    with drawing(len(sizes), size=(4.4, 3.1)) as (drawn, axes):
        for axis, size in zip(axes[0], sizes, strict=True):
            for drift in drifts:
                if drift.system.size == size:
                    steps, colour = range(1, len(drift.apart) + 1), ARMS[poles.index(drift.system.pole)]
                    label = f"{drift.system.words}, open loop {drift.system.pole:g}"
                    apart = np.maximum(drift.apart, _LEAST)
                    axis.plot(
                        steps,
                        apart,
                        "--" if drift.noise else "-",
                        color=colour,
                        lw=1.6,
                        label=label + (", noisy demonstrations" if drift.noise else ""),
                    )
            axis.axhline(GUST, color=SOFT, lw=0.8, ls=":")
            axis.set(yscale="log", xlabel="step", title=titles[size], ylim=(_LEAST, 100))
        axes[0, 0].set_ylabel("distance from the expert")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside lower center", ncols=3)
        return to_figure(drawn, "Distance of clones from the expert over the steps, of stable and unstable systems")


def errors_figure(shift: Shift) -> Figure:
    """Draw the share of wrong actions at each step, in the expert's states and in the policy's own."""
    chosen = list(dict.fromkeys((0, _best(shift))))
    with drawing(len(chosen), size=(4.4, 2.9)) as (drawn, axes):
        for axis, index in zip(axes[0], chosen, strict=True):
            one = shift.rounds[index]
            colour = CLONING if one.round == 0 else DAGGER
            axis.plot(100 * np.array(one.on_own.by_step), color=colour, lw=1.8, label="in its own states")
            if one.on_expert is not None:
                axis.plot(100 * np.array(one.on_expert.by_step), color=SOFT, lw=1.4, label="in the expert's states")
            axis.set(xlabel="control step", title=_name(one), ylim=(0, 100), xlim=(0, shift.env.horizon))
            axis.legend(loc="upper right")
        axes[0, 0].set_ylabel("wrong actions [%]")
        return to_figure(drawn, "Share of wrong actions by step, for cloning and for the best round")


def clouds_figure(shift: Shift) -> Figure:
    """Draw where the hand was, in the data and when the policy drove: from above and from the side, by round."""
    rounds = _spread(shift.rounds)
    with drawing(len(rounds), 2, size=(9.0 / len(rounds), 2.2), share=True) as (drawn, axes):
        for column, one in enumerate(rounds):
            for row, across in enumerate(((1, 0), (0, 2))):
                axis = axes[row, column]
                for places, colour in ((one.data, _DATA), (one.hand, CLONING if one.round == 0 else DAGGER)):
                    shown = places[:: max(1, len(places) // _POINTS)]
                    axis.scatter(*shown[:, across].T, s=2.5, color=colour, alpha=0.55, lw=0, rasterized=True)
                axis.set_aspect("equal", adjustable="box")
                axis.tick_params(labelsize=7.5)
            axes[0, column].set_title(_name(one), fontsize=9.5)
        axes[0, 0].invert_xaxis()
        axes[0, 0].set_ylabel("from above: x over y [m]", fontsize=8.5)
        axes[1, 0].set_ylabel("from the side: z over x [m]", fontsize=8.5)
        return to_figure(drawn, "Places of the hand in the data and in the policy's rollouts, by round")


def _best(shift: Shift) -> int:
    return max(range(len(shift.rounds)), key=lambda index: (shift.rounds[index].success.rate, index))


def _spread(rounds: Sequence[RoundShift]) -> list[RoundShift]:
    """At most `MOST_CLOUDS` rounds, the first ones closest together: there most changes."""
    if len(rounds) <= MOST_CLOUDS:
        return list(rounds)
    chosen = sorted({0, 1, 2, (len(rounds) + 2) // 2, len(rounds) - 1})
    return [rounds[index] for index in chosen]


def _name(one: RoundShift) -> str:
    return "cloning (round 0)" if one.round == 0 else f"round {one.round}"
