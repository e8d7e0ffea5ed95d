"""Inverse reinforcement learning on `carry`: a dataset's paths on the grids of their layouts, and their weights.

Layouts, goals and the object's places are read from what the environment shows; nothing else of a dataset is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manip_il.data import schema
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.errors import ManipError
from manip_il.rewards.paths import Demonstration
from manip_il.robots.table import get_robot
from manip_il.sim.scene import build_scene
from manip_il.tasks.furnishing import EDGE, observed_layout, space_of
from manip_il.tasks.grid import Grid
from manip_il.tasks.ladder import AT_GOAL
from manip_il.tasks.layout import THINGS
from manip_il.tasks.pick_place import OBJECT

F64 = NDArray[np.float64]
CARRY = "carry"
_MOVED = 0.004  # from where it stood, at which an object is on its way [m]


@dataclass(frozen=True)
class Carried:
    """Path of an episode. positions: of the object from where it stood to the goal, (T, 3) [m]."""

    episode: int
    grid: Grid
    positions: F64
    demonstration: Demonstration


def read_carried(root: Path, on_episode: Callable[[], None] = lambda: None) -> list[Carried]:
    """Return what was carried in a dataset's episodes that reached the goal, in order.

    Raises `ManipError` for a dataset of another task, and if no episode reached the goal.
    """
    dataset = Dataset.open(root)
    spec = dataset.spec
    places = _places(root, spec)
    table = dataset.columns([schema.ENVIRONMENT_STATE, schema.SUCCESS, EPISODE_INDEX])
    scene = build_scene(get_robot(spec.robot).name, CARRY, spec.object)
    index = table[EPISODE_INDEX].ravel()
    found = list[Carried]()
    for episode in np.unique(index).tolist():
        rows = table[schema.ENVIRONMENT_STATE][index == episode].astype(np.float64)
        on_episode()
        if not table[schema.SUCCESS][index == episode].any():
            continue
        layout = observed_layout(scene, OBJECT, {name: float(rows[0, column]) for name, column in places.items()})
        positions = carried_stretch(rows[:, [places[f"{OBJECT}.{axis}"] for axis in "xyz"]], np.array(layout.goal))
        found.append(follow(episode, Grid(layout, space_of(scene.robot)), positions))
    if not found:
        raise ManipError(f"{root}: in none of its {len(np.unique(index))} episodes the object gets to the goal")
    return found


def follow(episode: int, grid: Grid, positions: F64) -> Carried:
    """Return a path of the object's positions (T, 3) [m] as a demonstration on a grid.

    Raises `ManipError` if it does not lead to the goal on the grid.
    """
    path = grid.snap(positions)
    if len(path) < 2 or path[-1] != grid.goal:
        raise ManipError(f"episode {episode}: the object's path does not lead through free space to the goal")
    return Carried(episode, grid, positions, Demonstration(grid.problem, path))


def carried_stretch(positions: F64, goal: F64) -> F64:
    """Return the positions (T, 3) [m] from the last at which the object stood to the first at the goal (3,)."""
    moved = np.flatnonzero(np.linalg.norm(positions - positions[0], axis=1) > _MOVED)
    first = max(int(moved[0]) - 1, 0) if len(moved) else 0
    off = np.linalg.norm(positions - goal, axis=1)
    there = np.flatnonzero(off < AT_GOAL)
    last = int(there[0]) if len(there) else int(np.argmin(off))
    return positions[first : max(last, first) + 1]


def _places(root: Path, spec: schema.RobotTaskSpec) -> dict[str, int]:
    """Columns of `environment_state` by name; all that is needed is there."""
    needed = {f"{name}.{axis}" for name in (OBJECT, "goal", *THINGS, EDGE, f"{EDGE}.outwards") for axis in "xyz"}
    needed |= {f"{OBJECT}.width", *(f"{name}.here" for name in (*THINGS, EDGE))}
    if not needed <= set(spec.environment_state_names):
        raise ManipError(
            f"{root} is of the task {spec.task}; expected a dataset of manip-il record --task.type={CARRY}"
        )
    return {name: column for column, name in enumerate(spec.environment_state_names)}
