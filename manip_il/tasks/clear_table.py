"""Clear the table: put four cubes into a box."""

import math
from functools import partial
from itertools import product
from types import MappingProxyType

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.sim.task import Observed, Rung, Start, Task
from manip_il.sim.world import World
from manip_il.tasks.bins import (
    OVER,
    OVER_WALL,
    add_bin,
    drop_place,
    drop_rungs,
    is_in,
    nearest_to_hand,
    rise_over,
)
from manip_il.tasks.grasp import once_per_state
from manip_il.tasks.ladder import carry_progress, grasp_progress, grasp_rungs, is_held
from manip_il.tasks.objects import (
    BLUE,
    RED,
    UPRIGHT,
    YELLOW,
    add_cube,
    draw_few,
    draw_resting,
    draw_until,
    draw_yaw,
    observe_hand,
    observe_object,
)

COLOURS = {"red": RED, "blue": BLUE, "yellow": YELLOW, "white": (0.92, 0.92, 0.90)}
BOX = "box"
INSIDE = (0.075, 0.075)  # half the box's inner length and width [m]
HALF = 0.018  # half a cube's edge length [m]
SLOT = 0.032  # offset of a cube's release point from the box's middle, along each side [m]
SLOTS = {
    name: (x, y) for name, (y, x) in zip(COLOURS, product((-SLOT, SLOT), repeat=2), strict=True)
}
SIDE = 0.225  # offset of the box's middle from the workspace's, left or right [m]
APART = 0.08  # least distance between cubes at the start [m]
ROOM = 0.03  # reachable margin around a cube at the start [m]
FROM_BOX = 0.15  # least sideways distance of a cube from the box's middle at the start [m]


@once_per_state
def _left(world: World) -> tuple[str, ...]:
    """Cubes that are not in the box."""
    return tuple(name for name in COLOURS if not is_in(world, name, BOX, INSIDE))


def _inside(world: World, name: str) -> bool:
    return name not in _left(world)


@once_per_state
def current(world: World) -> str:
    """Return the cube that is in the hand, else the first that is not in the box.

    The last if all are.
    """
    left = _left(world) or tuple(COLOURS)[-1:]
    nearest = nearest_to_hand(world, left)
    return nearest if is_held(world, nearest) else left[0]


def _to(world: World) -> F64:
    """Release point of the current cube over its own quarter of the box, (3,) [m]."""
    name = current(world)
    return drop_place(world, name, BOX, SLOTS[name])


_LET_GO, _CARRY = drop_rungs(current, _to, _inside, tuple(COLOURS))


class ClearTable(Task):
    """Put all cubes from the table into the box."""

    name = "clear_table"
    instruction = "Put all cubes into the box."
    nouns = MappingProxyType({name: f"{name} cube" for name in COLOURS})
    place = "the box"
    subtasks = MappingProxyType({"done": "move away from {place}"})
    tolerance = 0.005
    horizon = 900
    objects = tuple(COLOURS)
    grasped = tuple(COLOURS)
    sizes = (0.03, 0.04)
    rungs = (
        _LET_GO,
        Rung("done", lambda w: not _left(w), lambda w: rise_over(w, BOX)),
        _CARRY,
        *grasp_rungs(current, OVER),
    )

    def moved(self, world: World, phase: str) -> str:
        """Return the cube in the hand, or the next one.

        Args:
            world: The world to look at.
            phase: Name of the phase that it is in.
        """
        return nearest_to_hand(world, [*COLOURS]) if phase == "let_go" else current(world)

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the cubes and the box."""
        for name, colour in COLOURS.items():
            add_cube(spec, name, HALF, 0.05, colour)
        add_bin(spec, BOX, INSIDE)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw the box's side, and the cubes on the table, apart and at any yaw."""
        x, y = world.robot.workspace.centre
        box = np.array([x + rng.uniform(-0.03, 0.03), y + rng.choice([-1.0, 1.0]) * SIDE, 0.0])

        def draw_cubes() -> dict[str, F64]:
            places: dict[str, F64] = {}

            def fits(at: F64) -> bool:
                apart = all(math.dist(at, other) > APART for other in places.values())
                return abs(at[1] - box[1]) > FROM_BOX and apart

            for name in COLOURS:
                at = draw_few(partial(draw_resting, rng, world, name, ROOM), fits)
                if at is None:
                    return {}
                places[name] = at
            return places

        cubes = draw_until(draw_cubes, bool, world, ", ".join(COLOURS))
        poses = {name: (at, draw_yaw(rng)) for name, at in cubes.items()}
        return Start({BOX: (box, UPRIGHT), **poses})

    def observe(self, world: World) -> Observed:
        """Return the hand, the box, the next cube and the vector to its place, and all cubes.

        Of each cube it returns the position, and whether it is in the box.
        """
        name = current(world)
        return {
            **observe_hand(world),
            BOX: world.at(BOX),
            **observe_object(world, name, "next"),
            "place_from_next": _to(world) - world.at(name),
            **{cube: world.at(cube) for cube in COLOURS},
            **{f"{cube}.in_box": float(_inside(world, cube)) for cube in COLOURS},
        }

    def error(self, world: World) -> float:
        """Return the distance from the box's middle, summed over the cubes that are outside [m]."""
        at = world.at(BOX)
        return sum(math.dist(world.at(name), at) for name in _left(world))

    def progress(self, world: World) -> float:
        """Return progress by the number of cubes in the box and the state of the next one."""
        done = len(COLOURS) - len(_left(world))
        if done == len(COLOURS):
            return 1.0
        name = current(world)
        part = 0.45 * grasp_progress(world, name, OVER)
        if is_held(world, name):
            part = 0.5 + 0.4 * carry_progress(world, name, _to(world), OVER_WALL)
        return (done + part) / len(COLOURS)
