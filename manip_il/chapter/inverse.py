"""Inverse reinforcement learning on `carry`: paths from a dataset, the weights inferred from them,
and their report.

Layouts, goals and object positions are read from `observation.environment_state`; unsuccessful
episodes are skipped. The results are the weights of a reward, `reward.json`, and the report of
`manip-il reward irl`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from manip_il.chapter.rewards import bayesian, max_entropy, max_margin
from manip_il.data import schema
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.errors import ManipError, warn
from manip_il.evaluation.report import Report, Section, Table
from manip_il.mdp import F64
from manip_il.robots.table import get_robot
from manip_il.tasks.carry.grid import (
    LENGTH,
    Demonstration,
    Grid,
    open_features,
    plan,
    rivals,
)
from manip_il.tasks.carry.layout import FEATURES
from manip_il.tasks.carry.obstacles import EDGE, observed_layout
from manip_il.tasks.ladder import AT_GOAL
from manip_il.tasks.pick_place import OBJECT
from manip_il.worlds.ladder.world import scene_of

METHODS = ("max_margin", "bayesian", "max_entropy")
LEVEL = 0.9  # level of the credible intervals
_TASTES = 20  # random weight vectors whose paths show whether a feature matters
CARRY = "carry"
_MOVED = 0.004  # distance from the start beyond which an object counts as moving [m]
FILE_NAME = "reward.json"


def read_carried(root: Path, on_episode: Callable[[], None] = lambda: None) -> list[Demonstration]:
    """Return the object's paths in a dataset's successful episodes, on grids over their layouts.

    Raises `ManipError` if the task is not `carry`, no episode succeeded, or a path leads through an
    obstacle.
    """
    dataset = Dataset.open(root)
    spec, names = dataset.spec, dataset.spec.environment_state_names
    if f"{EDGE}.here" not in names:
        raise ManipError(
            f"{root} has the task {spec.task}; expected a dataset of manip-il record"
            f" --task.type={CARRY}"
        )
    table = dataset.columns([schema.ENVIRONMENT_STATE, schema.SUCCESS, EPISODE_INDEX])
    scene = scene_of(get_robot(spec.robot).name, CARRY, spec.object)
    index = table[EPISODE_INDEX].ravel()
    at = [names.index(f"{OBJECT}.{axis}") for axis in "xyz"]
    found = list[Demonstration]()
    for episode in np.unique(index[table[schema.SUCCESS].ravel() != 0]).tolist():
        on_episode()
        rows = table[schema.ENVIRONMENT_STATE][index == episode].astype(np.float64)
        layout = observed_layout(scene, dict(zip(names, rows[0].tolist(), strict=True)))
        positions = carried_stretch(rows[:, at], np.array(layout.goal))
        grid = Grid(layout, scene.robot)
        path = grid.snap(positions)
        if len(path) < 2 or path[-1] != grid.goal:
            raise ManipError(
                f"episode {episode}: the object's path does not lead through free space to the goal"
            )
        found.append(Demonstration(grid.problem, path))
    if not found:
        raise ManipError(f"{root}: the object reaches the goal in none of its episodes")
    return found


def carried_stretch(positions: F64, goal: F64) -> F64:
    """Return the positions (T, 3) [m] from the last one before the object moves to the first one
    at the goal (3,).
    """
    moved = np.flatnonzero(np.linalg.norm(positions - positions[0], axis=1) > _MOVED)
    first = max(int(moved[0]) - 1, 0) if len(moved) else 0
    off = np.linalg.norm(positions - goal, axis=1)
    there = np.flatnonzero(off < AT_GOAL)
    last = int(there[0]) if len(there) else int(np.argmin(off))
    return positions[first : max(last, first) + 1]


@dataclass(frozen=True)
class Learnt:
    """The weights that a method found.

    Attributes:
        method: One of `METHODS`.
        weights: The weights, divided by the weight of length, (K,); those that are not identified
            are 0.
        open: Indices of the weights that are not identified, see `open_features`.
        intervals: The weights' credible intervals, (K, 2), or None.
        gap: Duality gap of `max_margin`, relative to its objective, or None.
    """

    method: str
    weights: F64
    open: tuple[int, ...] = ()
    intervals: F64 | None = None
    gap: float | None = None


def learn(method: str, demonstrations: Sequence[Demonstration], rng: np.random.Generator) -> Learnt:
    """Return the weights that a method infers from demonstrations.

    Args:
        method: One of `METHODS`.
        demonstrations: One or more demonstrations.
        rng: Draws the weights whose paths show which features matter, and the samples of
            `bayesian`.

    Returns:
        The weights, with credible intervals if the method is `bayesian`. A warning names weights
        that `max_entropy` left at their lower bounds.
    """
    tastes = rng.exponential(bayesian.PRIOR, (_TASTES, demonstrations[0].problem.features.shape[1]))
    unknown = open_features(demonstrations, rivals(demonstrations, tastes))
    more = dict[str, Any]()
    if method == "bayesian":
        draws = bayesian.fit(demonstrations, rng)
        weights, ratios = draws.mean(axis=0), draws / draws[:, [LENGTH]]
        more["intervals"] = np.quantile(ratios, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0).T
    elif method == "max_margin":
        weights, more["gap"] = max_margin.fit(demonstrations)
    else:
        weights = max_entropy.fit(demonstrations)
        pinned = [k for k in max_entropy.pinned(demonstrations, weights) if k not in unknown]
        if pinned:
            names = ", ".join(f"{FEATURES[k]} ({weights[k]:.0f} / m)" for k in pinned)
            warn(
                f"maximum entropy left weights at their lower bounds: {names}; their ratios may be"
                " wrong, so compare with --method=bayesian"
            )
    weights = weights / weights[LENGTH]
    weights[unknown] = 0.0
    return Learnt(method, weights, tuple(unknown), **more)


@dataclass(frozen=True)
class Inverse:
    """Learnt weights and the paths that they were learnt from.

    Attributes:
        source: The dataset, in words.
        demonstrations: The demonstrated paths.
        learnt: The weights.
    """

    source: str
    demonstrations: tuple[Demonstration, ...]
    learnt: Learnt

    @property
    def open_names(self) -> tuple[str, ...]:
        """Features whose weights the demonstrations do not determine."""
        return tuple(FEATURES[k] for k in self.learnt.open)

    @property
    def facts(self) -> tuple[str, ...]:
        """How far weights of maximum margin are from optimal; empty for other methods."""
        gap = self.learnt.gap
        return () if gap is None else (f"duality gap: {gap:.1e} of the objective",)

    @cached_property
    def means(self) -> tuple[F64, F64]:
        """Mean features of the demonstrations and of the cheapest paths from their starts, (K,)
        [m].
        """
        shown, weights = self.demonstrations, self.learnt.weights
        planned = [plan(one.problem, weights).path(one.start)[1] for one in shown]
        return np.mean([one.sums for one in shown], axis=0), np.mean(planned, axis=0)

    @property
    def excess(self) -> float:
        """Share by which the demonstrations cost more than the re-planned paths, at the learnt
        weights.
        """
        shown, planned = self.means
        return float(shown @ self.learnt.weights / (planned @ self.learnt.weights) - 1)

    def to_json(self) -> dict[str, Any]:
        """Return the content of `reward.json`; only `names` and `weights` are needed to load it."""
        known = [k for k in range(len(FEATURES)) if k not in self.learnt.open]
        intervals = self.learnt.intervals
        return {
            "names": [FEATURES[k] for k in known],
            "weights": self.learnt.weights[known].tolist(),
            "intervals": None if intervals is None else intervals[known].tolist(),
            "level": None if intervals is None else LEVEL,
            "not_identified": self.open_names,
            "method": self.learnt.method,
            "demonstrations": len(self.demonstrations),
            "source": self.source,
            "excess": self.excess,
        }


def weight_table(found: Inverse) -> Table:
    """Return a table of the weights, one row per feature."""
    learnt = found.learnt
    shown, planned = found.means
    rows = []
    for k, name in enumerate(FEATURES):
        weight, interval = f"{learnt.weights[k]:.2f}", ""
        if k in learnt.open:
            weight = "not identified"
        elif learnt.intervals is not None:
            interval = "[{:.2f}, {:.2f}]".format(*learnt.intervals[k])
        rows.append(
            (name.replace("_", " "), weight, interval, f"{shown[k]:.3f}", f"{planned[k]:.3f}")
        )
    columns = ("per metre", "weight", f"{LEVEL:.0%} interval", "shown [m]", "planned [m]")
    return Table(columns, tuple(rows)).filled()


def inverse_report(found: Inverse) -> Report:
    """Return the report of the learnt weights."""
    names, notes = ", ".join(found.open_names), list(found.facts)
    if names:
        notes.append(
            f"No demonstration differs from its alternatives in {names}, so these weights are"
            " not identified. The reward omits them, and plans with 0 instead."
        )
    weights = Section("What a metre costs", tables=(weight_table(found),), notes=tuple(notes))
    return Report(
        title="Costs inferred from demonstrations",
        verdict=(
            f"By the learnt weights, the {len(found.demonstrations)} demonstrations cost"
            f" {found.excess:.1%} more than the cheapest paths."
        ),
        sections=(weights,),
    )
