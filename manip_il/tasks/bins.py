"""Open boxes, and the ladder that drops objects into them."""

import math
from collections.abc import Callable, Sequence

import mujoco

from manip_il.mdp import F64
from manip_il.robots.geometry import hand_down
from manip_il.sim.task import Rung, Target
from manip_il.sim.world import World
from manip_il.tasks.grasp import lie_of
from manip_il.tasks.ladder import LiftProfile, Place, Which, carry, hand_is_at, is_held, let_go
from manip_il.tasks.objects import WOOD, Colour, add_furniture, add_part, add_sides

WALL, THIN = 0.05, 0.003  # height of a box, half the thickness of walls and floor [m]
DROP = 0.02  # height of an object's bottom over a box's floor at release [m]
# over a box's wall
OVER_WALL = LiftProfile(most=0.065, slope=2.5, free=0.012, rise_first=0.03, max_step=0.045)
OVER = 0.11  # height of the hand over an object on approach [m]
AWAY = 0.2  # height of the hand over a box once its work there is done [m]
# offsets within which the hand is still at an object in a box: sideways, above [m]
_AT = (0.035, 0.05)
_RISE = 0.10  # height of the hand over an object after release [m]


def add_bin(
    spec: mujoco.MjSpec, name: str, inside: tuple[float, float], colour: Colour = WOOD
) -> None:
    """Add an open box, whose pose is set at the start of an episode.

    Args:
        spec: The scene to add it to.
        name: The name of its body.
        inside: Half its inner length and width, (2,) [m].
        colour: Red, green and blue, 0 to 1.
    """
    box, high = add_furniture(spec, name), WALL / 2
    length, width = inside
    x, y = length + THIN, width + THIN
    across, along = (length + 2 * THIN, THIN, high), (THIN, width, high)
    add_part(box, f"{name} floor", (length, width, THIN), (0, 0, THIN), colour)
    add_sides(box, name, across, (0, y, high), colour)
    add_part(box, f"{name} far", along, (x, 0, high), colour)
    add_part(box, f"{name} near", along, (-x, 0, high), colour)


def is_in(world: World, name: str, box: str, inside: tuple[float, float]) -> bool:
    """Return whether an object's centre is between a box's walls.

    Args:
        world: The world to look at.
        name: The object's name.
        box: The box's name.
        inside: Half the box's inner length and width, along the world's x and y, (2,) [m].
    """
    x, y, z = (world.at(name) - world.at(box)).tolist()
    return abs(x) < inside[0] and abs(y) < inside[1] and z < WALL + 0.01


def nearest_to_hand(world: World, names: Sequence[str]) -> str:
    """Return the object, of those named, whose centre is nearest to the hand."""
    ee = world.ee.position.tolist()
    return min(names, key=lambda name: math.dist(world.at(name).tolist(), ee))


def drop_rungs(
    which: Which,
    to: Place,
    is_done: Callable[[World, str], bool],
    names: Sequence[str],
    lift: LiftProfile = OVER_WALL,
) -> tuple[Rung, ...]:
    """Return the rungs that carry the current object over a box and drop it in.

    Args:
        which: Returns the name of the current object.
        to: Returns where to release that object's centre, (3,) [m].
        is_done: Returns whether the object of a given name is in its box.
        names: All objects that may be in the hand. The one nearest to the hand is let go once
            it is in its box.
        lift: The height of the object on its way to the box.

    Returns:
        The rungs `let_go` and `carry`, in this order.
    """

    def nearest(world: World) -> str:
        return nearest_to_hand(world, names)

    def at_done(world: World) -> bool:
        name = nearest(world)
        return hand_is_at(world, name, *_AT) and is_done(world, name)

    return (
        Rung("let_go", at_done, lambda w: let_go(w, nearest(w), _RISE)),
        Rung("carry", lambda w: is_held(w, which(w)), lambda w: carry(w, which(w), to(w), lift)),
    )


def rise_over(world: World, box: str) -> Target:
    """Rise to a point over a box, fingers open."""
    at = world.at(box) + [0.0, 0.0, AWAY]
    return Target(at, hand_down(world.ahead(at)), world.gripper.most)


def drop_place(world: World, name: str, box: str, offset: Sequence[float] = (0.0, 0.0)) -> F64:
    """Return where to release an object's centre over a box, (3,) [m].

    Args:
        world: The world to look at.
        name: The object's name.
        box: The box's name.
        offset: The place's offset from the middle of the box's floor along the world's x and y,
            (2,) [m].
    """
    height = 2 * THIN + lie_of(world, name).tall / 2 + DROP
    return world.at(box) + [offset[0], offset[1], height]
