"""The page and the file of `manip-il reward irl`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.algorithms.inverse import Carried
from manip_il.algorithms.inverse_figures import cost_figure, trace_figure
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.tables import Table
from manip_il.rewards.methods import LEVEL, Learnt, prior_interval
from manip_il.rewards.paths import cheapest_path, plan
from manip_il.tasks.reward import FEATURES

F64 = NDArray[np.float64]
PAGE, FILE_NAME = "report.html", "reward.json"
_ASSUMES = {
    "max_margin": (
        "min over w of  λ/2 |w|² + mean over demonstrations of  [ w·f(demonstration) - min over paths (w·f - margin) ]",
    ),
    "bayesian": ("p(w) = Π exp(-w_k / m) / m;   p(demonstration | w) = exp(-w·f) / Σ over its rivals exp(-w·f)",),
    "max_entropy": ("p(path) = exp(-w·f) / Z(w);   gradient = f(demonstrations) - E[f]",),
}


@dataclass(frozen=True)
class Inverse:
    """Weights and whom they were learnt of. source: the dataset, in words."""

    source: str
    carried: tuple[Carried, ...]
    learnt: Learnt

    @property
    def open_names(self) -> tuple[str, ...]:
        """Features of which nothing is known."""
        return tuple(FEATURES[k] for k in self.learnt.open)

    @cached_property
    def weights(self) -> F64:
        """Weights to plan with, (K,): those of which nothing is known are 0."""
        found = self.learnt.weights.copy()
        found[list(self.learnt.open)] = 0.0
        return found

    @cached_property
    def replanned(self) -> tuple[tuple[NDArray[np.int64], F64], ...]:
        """The cheapest paths in the demonstrations' places: nodes (n,) and features (K,)."""
        shown = [one.demonstration for one in self.carried]
        return tuple(cheapest_path(one.problem, plan(one.problem, self.weights), one.start) for one in shown)

    @property
    def means(self) -> tuple[F64, F64]:
        """Mean features of the demonstrations and of the re-planned paths, (K,) [m]."""
        shown = np.mean([one.demonstration.sums for one in self.carried], axis=0)
        return shown, np.mean([sums for _, sums in self.replanned], axis=0)

    @property
    def excess(self) -> float:
        """Share that the demonstrations cost above the re-planned paths for these weights."""
        shown, planned = self.means
        return float(shown @ self.weights / (planned @ self.weights) - 1)

    def to_json(self) -> dict[str, Any]:
        """Return everything for `reward.json`, whose `names` and `weights` a reward is read from."""
        known = [k for k in range(len(FEATURES)) if k not in self.learnt.open]
        intervals = self.learnt.intervals
        return {
            "names": [FEATURES[k] for k in known],
            "weights": [float(self.weights[k]) for k in known],
            "intervals": None if intervals is None else [intervals[k].tolist() for k in known],
            "level": None if intervals is None else LEVEL,
            "not_identified": {name: list(prior_interval()) for name in self.open_names},
            "method": self.learnt.method,
            "demonstrations": len(self.carried),
            "source": self.source,
            "excess": self.excess,
        }


def weight_table(found: Inverse) -> Table:
    """Return the weights, one row a feature."""
    learnt, (shown, planned) = found.learnt, found.means
    beside = learnt.beside
    rows = [
        (
            name.replace("_", " "),
            "not identified" if k in learnt.open else f"{learnt.weights[k]:.2f}",
            _interval(learnt, k),
            f"{beside[1][k]:.2f}" if beside else "",
            f"{shown[k]:.3f}",
            f"{planned[k]:.3f}",
        )
        for k, name in enumerate(FEATURES)
    ]
    columns = ("per metre", "weight", f"{LEVEL:.0%} interval", beside[0] if beside else "", "shown [m]", "planned [m]")
    return Table(columns, tuple(rows)).filled()


def _interval(learnt: Learnt, k: int) -> str:
    if k in learnt.open:
        low, high = prior_interval()
        return f"[{low:.2g}, {high:.2g}] (prior)"
    return "" if learnt.intervals is None else "[{:.2f}, {:.2f}]".format(*learnt.intervals[k])


def open_line(found: Inverse) -> str:
    """Return which weights are not identified, as a sentence; empty where all are."""
    if not found.open_names:
        return ""
    return (
        f"All demonstrations agree in {', '.join(found.open_names)}: nothing tells these weights, which are left out "
        "of the reward (0 when it is planned with)."
    )


def inverse_report(found: Inverse, command: str, config: Mapping[str, Any], timings: Mapping[str, float]) -> Report:
    """Return the report of what was learnt."""
    sections = [
        Section(
            "What a metre costs",
            formulas=_ASSUMES[found.learnt.method],
            tables=(weight_table(found),),
            notes=tuple(one for one in (*found.learnt.facts, open_line(found)) if one),
        ),
        Section(
            "The cost over the table",
            figures=(cost_figure(found.carried, [nodes for nodes, _ in found.replanned], found.weights),),
            notes=(
                "Cost of a metre of path at the height at which the object was carried, from above; things in grey. "
                "Solid: as demonstrated. Dashed: the cheapest path for these weights.",
            ),
        ),
    ]
    if found.learnt.draws is not None:
        figure = trace_figure(found.learnt.draws, FEATURES)
        sections.append(Section("The chains", figures=(figure,), notes=("Weights over that of length, draw by draw.",)))
    return Report(
        title="What the demonstrations care about",
        verdict=_verdict(found),
        command=command,
        config=config,
        timings=timings,
        sections=tuple(sections),
    )


def _verdict(found: Inverse) -> str:
    order = [k for k in np.argsort(-found.weights).tolist() if k != 0 and found.weights[k] > 0][:3]
    words = ", ".join(f"{found.weights[k]:.1f} {FEATURES[k].replace('_', ' ')}" for k in order)
    return (
        f"{len(found.carried)} demonstrations pay {found.excess:.1%} more than the cheapest paths for the weights that "
        f"were learnt of them; a metre that costs 1 for its length costs besides: {words or 'nothing'}."
    )


def summary_lines(found: Inverse) -> Sequence[str]:
    """Return the weights as plain lines."""
    return weight_table(found).aligned_lines()
