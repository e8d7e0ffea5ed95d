"""Inverse reinforcement learning on `carry`: paths from a dataset, the weights inferred from them, and their report.

Layouts, goals and object positions are read from `observation.environment_state`; unsuccessful episodes are skipped.
The results are the weights of a reward, `reward.json`, and the report of `manip-il reward irl`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from manip_il.chapter.rewards.methods import LEVEL, Learnt, prior_interval
from manip_il.data import schema
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.errors import ManipError
from manip_il.evaluation.figures import CLONING, DAGGER, SOFT, Figure, drawing, to_figure
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.tables import Table
from manip_il.mdp import F64, I64
from manip_il.robots.table import get_robot
from manip_il.tasks.carry.grid import Grid
from manip_il.tasks.carry.layout import FEATURES, OBSTACLES
from manip_il.tasks.carry.obstacles import EDGE, observed_layout
from manip_il.tasks.carry.paths import Demonstration, cheapest_path, plan
from manip_il.tasks.ladder import AT_GOAL
from manip_il.tasks.pick_place import OBJECT
from manip_il.worlds.ladder.envs import scene_of

CARRY = "carry"
_MOVED = 0.004  # distance from the start beyond which an object counts as moving [m]
FILE_NAME = "reward.json"
_PANELS = 3
_SIDE = 80  # points along each side of the map


@dataclass(frozen=True)
class Carried:
    """The path of an episode's object. positions: from its start to the goal, (T, 3) [m]."""

    episode: int
    grid: Grid
    positions: F64
    demonstration: Demonstration


def read_carried(root: Path, on_episode: Callable[[], None] = lambda: None) -> list[Carried]:
    """Return the object's paths in a dataset's successful episodes, in order.

    Raises `ManipError` if the task is not `carry`, no episode succeeded, or a path leads through an obstacle.
    """
    dataset = Dataset.open(root)
    spec = dataset.spec
    places = {name: column for column, name in enumerate(spec.environment_state_names)}
    if f"{EDGE}.here" not in places:
        raise ManipError(f"{root} has the task {spec.task}; expected a dataset of manip-il record --task.type={CARRY}")
    table = dataset.columns([schema.ENVIRONMENT_STATE, schema.SUCCESS, EPISODE_INDEX])
    scene = scene_of(get_robot(spec.robot).name, CARRY, spec.object)
    index = table[EPISODE_INDEX].ravel()
    found = list[Carried]()
    for episode in np.unique(index).tolist():
        rows = table[schema.ENVIRONMENT_STATE][index == episode].astype(np.float64)
        on_episode()
        if not table[schema.SUCCESS][index == episode].any():
            continue
        layout = observed_layout(scene, OBJECT, {name: float(rows[0, column]) for name, column in places.items()})
        positions = carried_stretch(rows[:, [places[f"{OBJECT}.{axis}"] for axis in "xyz"]], np.array(layout.goal))
        grid = Grid(layout, scene.robot)
        path = grid.snap(positions)
        if len(path) < 2 or path[-1] != grid.goal:
            raise ManipError(f"episode {episode}: the object's path does not lead through free space to the goal")
        found.append(Carried(episode, grid, positions, Demonstration(grid.problem, path)))
    if not found:
        raise ManipError(f"{root}: the object reaches the goal in none of its {len(np.unique(index))} episodes")
    return found


def carried_stretch(positions: F64, goal: F64) -> F64:
    """Return the positions (T, 3) [m] from the last one before the object moves to the first one at the goal (3,)."""
    moved = np.flatnonzero(np.linalg.norm(positions - positions[0], axis=1) > _MOVED)
    first = max(int(moved[0]) - 1, 0) if len(moved) else 0
    off = np.linalg.norm(positions - goal, axis=1)
    there = np.flatnonzero(off < AT_GOAL)
    last = int(there[0]) if len(there) else int(np.argmin(off))
    return positions[first : max(last, first) + 1]


@dataclass(frozen=True)
class Inverse:
    """Learnt weights and the paths that they were learnt from. source: the dataset, in words."""

    source: str
    carried: tuple[Carried, ...]
    learnt: Learnt

    @property
    def open_names(self) -> tuple[str, ...]:
        """Features whose weights the demonstrations do not determine."""
        return tuple(FEATURES[k] for k in self.learnt.open)

    @cached_property
    def weights(self) -> F64:
        """Weights to plan with, (K,); undetermined ones are 0."""
        found = self.learnt.weights.copy()
        found[list(self.learnt.open)] = 0.0
        return found

    @cached_property
    def replanned(self) -> tuple[tuple[I64, F64], ...]:
        """Cheapest paths from the demonstrations' starts: nodes (n,) and features (K,) of each."""
        shown = [one.demonstration for one in self.carried]
        return tuple(cheapest_path(one.problem, plan(one.problem, self.weights), one.start) for one in shown)

    @property
    def means(self) -> tuple[F64, F64]:
        """Mean features of the demonstrations and of the re-planned paths, (K,) [m]."""
        shown = np.mean([one.demonstration.sums for one in self.carried], axis=0)
        return shown, np.mean([sums for _, sums in self.replanned], axis=0)

    @property
    def excess(self) -> float:
        """Share by which the demonstrations cost more than the re-planned paths, at the learnt weights."""
        shown, planned = self.means
        return float(shown @ self.weights / (planned @ self.weights) - 1)

    def to_json(self) -> dict[str, Any]:
        """Return the content of `reward.json`; only `names` and `weights` are needed to load it."""
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
    """Return a table of the weights, one row per feature."""
    learnt = found.learnt
    shown, planned = found.means
    rows = []
    for k, name in enumerate(FEATURES):
        weight, interval = f"{learnt.weights[k]:.2f}", ""
        if k in learnt.open:
            weight, interval = "not identified", "[{:.2g}, {:.2g}] (prior)".format(*prior_interval())
        elif learnt.intervals is not None:
            interval = "[{:.2f}, {:.2f}]".format(*learnt.intervals[k])
        rows.append((name.replace("_", " "), weight, interval, f"{shown[k]:.3f}", f"{planned[k]:.3f}"))
    columns = ("per metre", "weight", f"{LEVEL:.0%} interval", "shown [m]", "planned [m]")
    return Table(columns, tuple(rows)).filled()


def open_line(found: Inverse) -> str:
    """Return a sentence that names the weights that are not identified; empty if there are none."""
    if not found.open_names:
        return ""
    return (
        f"No demonstration differs from its alternatives in {', '.join(found.open_names)}, so these weights are not "
        "identified. The reward omits them, and plans with 0 instead."
    )


def inverse_report(found: Inverse) -> Report:
    """Return the report of the learnt weights."""
    weights = Section(
        "What a metre costs",
        tables=(weight_table(found),),
        notes=tuple(one for one in (found.learnt.chains, open_line(found)) if one),
    )
    costs = Section(
        "The cost over the table",
        figures=(_cost_figure(found),),
        notes=(
            "Cost of a metre of path, seen from above, at the height at which the object was carried; things in grey. "
            "Solid: demonstrated path. Dashed: cheapest path for these weights.",
        ),
    )
    return Report(
        title="Costs inferred from demonstrations",
        verdict=f"By the learnt weights, the {len(found.carried)} demonstrations cost {found.excess:.1%} more than the "
        "cheapest paths.",
        sections=(weights, costs),
    )


def _cost_figure(found: Inverse) -> Figure:
    """Maps of the cost per metre, with demonstrated and planned path, for layouts with the most things on the table."""
    count = [len(one.grid.layout.places) + (one.grid.layout.edge is not None) for one in found.carried]
    chosen = np.argsort(-np.array(count), kind="stable")[:_PANELS].tolist()
    with drawing(len(chosen), size=(3.0, 3.1)) as (drawn, axes):
        for axis, number in zip(axes[0], chosen, strict=True):
            one = found.carried[number]
            image = _draw_cost(axis, one, found.weights)
            path = one.grid.points[found.replanned[number][0]]
            axis.plot(*one.positions[:, :2].T, "-", color=DAGGER, lw=1.8, label="demonstrated")
            axis.plot(*path[:, :2].T, "--", color=CLONING, lw=1.6, label="re-planned")
            axis.plot(*one.grid.layout.goal[:2], "o", color=CLONING, ms=5)
            drawn.colorbar(image, ax=axis, location="bottom", shrink=0.8, pad=0.02)
            axis.set(title=f"episode {one.episode}", xticks=[], yticks=[], aspect="equal")
            axis.grid(visible=False)
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
        return to_figure(drawn, "Cost of a metre of path over the table, with demonstrated and re-planned paths")


def _draw_cost(axis: Any, one: Carried, weights: F64) -> Any:
    """Draw the cost per metre at the path's median height, and the obstacles, seen from above."""
    layout, points = one.grid.layout, one.grid.points
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    x, y = (np.linspace(low[k], high[k], _SIDE) for k in (0, 1))
    height = float(np.median(one.positions[:, 2]))
    places = np.stack([*(part.ravel() for part in np.meshgrid(x, y)), np.full(_SIDE**2, height)], axis=1)
    cost = (layout.densities(places) @ weights).reshape(_SIDE, _SIDE)
    image = axis.imshow(cost, origin="lower", extent=(low[0], high[0], low[1], high[1]), cmap="Greens")
    for name, (px, py) in layout.places:
        half = layout.scale * np.array(OBSTACLES[name].half)
        box_x, box_y = px + half[0] * np.array([-1, 1, 1, -1, -1]), py + half[1] * np.array([-1, -1, 1, 1, -1])
        axis.fill(box_x, box_y, color=SOFT, alpha=0.6, lw=0)
        axis.annotate(name, (px, py), ha="center", va="center", fontsize=6.5)
    return image
