"""Where in its workspace a robot's hand gets to, and from where tasks begin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UsageError
from manip_il.robots.reach import Reach, reach_of
from manip_il.robots.robot import Robot
from manip_il.seeding import rng_for
from manip_il.sim.world import Scene, World
from manip_il.tasks.table import get_task

F64 = NDArray[np.float64]
STARTS = 50  # of each task that are drawn
ENOUGH = 0.95  # share of a workspace that a robot reaches, of one that suits it
LOW = 0.03  # height of what lies on the table [m]
_FEW = 3  # starts without a place, after which no more are drawn
_ACROSS = 41  # points of a share along each edge of the workspace
_CELL = 0.02  # of the picture [m]
_MARGIN = 0.12  # of the picture around the workspace [m]
_NARROWER = 0.01  # steps in which a smaller workspace is tried [m]
_HEIGHTS = 8  # in the air


@dataclass(frozen=True)
class ReachFacts:
    """Shares of points in the workspace that the hand gets to, upright: on the table, and anywhere above it.

    leaning: on the table, by a hand that may lean. half_width: the widest at which a share of `ENOUGH` of the table is
    reached [m]; 0 where there is none. rows: runs of the map over the table, for the picture.
    """

    table: float
    air: float
    leaning: float
    half_width: float
    rows: tuple[Run, ...]


@dataclass(frozen=True)
class Run:
    """Neighbouring cells along x alike: their lower left corner and length, x, y, dx, dy [m]; upright or leaning."""

    x: float
    y: float
    dx: float
    dy: float
    upright: bool


@dataclass(frozen=True)
class StartFacts:
    """Starts of a task that found a place, of so many drawn; why one did not.

    objects, goals: where on the table they are, x and y [m]. goals: of what goals and furniture there is.
    """

    found: int
    drawn: int
    why: str
    objects: tuple[tuple[float, float], ...]
    goals: tuple[tuple[float, float], ...]


def reach_facts(robot: Robot) -> ReachFacts:
    """Return what of a robot's workspace its hand reaches; takes seconds where its map is not kept yet."""
    reach, space = reach_of(robot), robot.workspace
    air = [_share(robot, reach, z, space.half_width) for z in np.linspace(LOW, space.height, _HEIGHTS)]
    widths = np.arange(space.half_width, 0.0, -_NARROWER)
    enough = (float(half) for half in widths if _share(robot, reach, LOW, float(half)) >= ENOUGH)
    points = [(*at, LOW) for at in _grid(robot, space.half_width)]
    leaning = float(np.mean([reach.leaning(at) for at in points]))
    table = _share(robot, reach, LOW, space.half_width)
    return ReachFacts(table, float(np.mean(air)), leaning, round(next(enough, 0.0), 3), tuple(_runs(robot, reach)))


def start_facts(scene: Scene, seeds: Sequence[int]) -> StartFacts:
    """Draw the starts of seeds as episodes do; stops after a few that find no place."""
    world, task = World(scene), get_task(scene.task)
    world.update()
    objects, goals, why, found, drawn = list[tuple[float, float]](), list[tuple[float, float]](), "", 0, 0
    for seed in seeds:
        if drawn - found == _FEW:
            break
        drawn += 1
        try:
            poses = task.draw(rng_for(seed, "reset"), world).poses
        except UsageError as error:
            why = str(error)
            continue
        found += 1
        for name, (at, _) in poses.items():
            (objects if name in scene.objects else goals).append((float(at[0]), float(at[1])))
    return StartFacts(found, drawn, why, tuple(objects), tuple(goals))


def _share(robot: Robot, reach: Reach, height: float, half: float) -> float:
    return float(np.mean([reach.has((*at, height)) for at in _grid(robot, half)]))


def _grid(robot: Robot, half: float) -> list[tuple[float, float]]:
    (x, y), steps = robot.workspace.centre, np.linspace(-half, half, _ACROSS).tolist()
    return [(x + dx, y + dy) for dx in steps for dy in steps]


def _runs(robot: Robot, reach: Reach) -> Iterator[Run]:
    """Yield the cells around the workspace that the hand gets to on the table, those alike along x as one."""
    (x, y), half = robot.workspace.centre, robot.workspace.half_width + _MARGIN
    count = round(2 * half / _CELL)
    for row in range(count):
        low = y - half + row * _CELL
        begin, before = 0, 0
        for column in range(count + 1):
            at = (x - half + (column + 0.5) * _CELL, low + _CELL / 2, LOW)
            kind = 0 if column == count else 2 if reach.has(at) else 1 if reach.leaning(at) else 0
            if kind != before:
                if before:
                    yield Run(x - half + begin * _CELL, low, (column - begin) * _CELL, _CELL, before == 2)
                begin, before = column, kind
