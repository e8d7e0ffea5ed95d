"""Random starts within an arm's reach."""

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
from mujoco import mjtGeom

from manip_il.errors import UsageError
from manip_il.mdp import F64
from manip_il.sim.world import World
from manip_il.tasks.grasp import is_cube

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])  # wxyz
# least horizontal distance from hand to object, as in gymnasium-robotics' FetchPickAndPlace [m]
FROM_HAND = 0.1
FROM_HAND_SHARE = 0.75  # the same as a share of the workspace's half width, if that is less
IN_AIR = 0.5  # share of goals above the table, as in FetchPickAndPlace
FEW_DRAWS = 50  # draws of one place before the other places are drawn again, too
_MOST_DRAWS = 1_000
_BOX, _SPHERE, _CAPSULE = (
    int(kind) for kind in (mjtGeom.mjGEOM_BOX, mjtGeom.mjGEOM_SPHERE, mjtGeom.mjGEOM_CAPSULE)
)
_HALF = np.sqrt(0.5)
# turn x, y or z up
UPWARDS = (np.array([_HALF, 0.0, -_HALF, 0.0]), np.array([_HALF, _HALF, 0.0, 0.0]), UPRIGHT)


def draw_lying(rng: np.random.Generator, world: World, name: str) -> tuple[F64, F64]:
    """Draw a pose of an object at rest.

    Sides that look alike count once. A capsule lies on its side; a mesh rests as modelled or, if it
    cannot, on the side nearest to its modelled underside. A cube's yaw is within +-pi/4, as its
    faces are alike.

    Args:
        rng: The source of random numbers.
        world: The world, for the arm's reach and the object's shape.
        name: The object's name.

    Returns:
        The position (3,) [m] and the quaternion wxyz (4,) of the object.

    Raises:
        UsageError: If no place fits within the arm's reach.
    """
    if is_cube(world, name):
        return draw_resting(rng, world, name), draw_yaw(rng)
    if (hull := world.hull(name)) is not None:
        height, turn = hull.rest(0).height, np.empty(4)
        mujoco.mju_quatZ2Vec(turn, -hull.downs[0])
        turn *= [1.0, -1.0, -1.0, -1.0]  # the smallest rotation that turns this side down
    else:
        lengths = world.extents(name)
        sides = _sides(world.kind(name), lengths)
        up = sides[int(rng.integers(len(sides)))]
        height, turn = lengths[up] / 2, UPWARDS[up]
    at = draw_resting(rng, world, name, height=height)
    return at, product(draw_yaw(rng, np.pi), turn)


def _sides(kind: int, lengths: Sequence[float]) -> list[int]:
    """Axes (0 to 2) that may point up when the object rests; axes of the same length count once."""
    if kind in (_SPHERE, _CAPSULE):
        return [0]
    return [
        axis
        for axis in range(3)
        if lengths[axis] not in lengths[:axis] or (kind != _BOX and axis == 2)
    ]


def draw_resting(
    rng: np.random.Generator,
    world: World,
    name: str,
    room: float = 0.0,
    height: float | None = None,
) -> F64:
    """Draw a place where an object's centre is at rest, not under the hand, (3,) [m].

    Args:
        rng: The source of random numbers.
        world: The world, for the arm's reach and the object's height.
        name: The object's name.
        room: The margin around the place that must also be within reach, so that a knocked object
            stays within reach [m].
        height: The height of the place over the table, by default `resting_height` [m].

    Raises:
        UsageError: If no place fits within the arm's reach.
    """
    space, z = world.robot.workspace, resting_height(world, name) if height is None else height
    apart = min(FROM_HAND, FROM_HAND_SHARE * space.half_width)

    def fits(at: F64) -> bool:
        around = ((0, 0, 0), (room, 0, 0), (-room, 0, 0), (0, room, 0), (0, -room, 0))
        from_hand = float(np.linalg.norm(at[:2] - space.centre))
        return from_hand >= apart and all(world.reach.has(at + way) for way in around)

    return draw_until(lambda: np.append(draw_xy(rng, world), z), fits, world, name)


def draw_goal(rng: np.random.Generator, world: World, height: float, in_air: float = IN_AIR) -> F64:
    """Draw a goal at a height over the table or in the air above, (3,) [m].

    Args:
        rng: The source of random numbers.
        world: The world, for the arm's workspace and reach.
        height: The least height of the goal over the table [m].
        in_air: The probability that the goal is anywhere above that height, not just at it.

    Raises:
        UsageError: If no place fits within the arm's reach.
    """
    top = world.robot.workspace.height if rng.uniform() < in_air else 0.0
    return draw_until(
        lambda: np.append(draw_xy(rng, world), height + rng.uniform(0, top)),
        world.reach.has,
        world,
        "the goal",
    )


def draw_yaw(rng: np.random.Generator, widest: float = np.pi / 4) -> F64:
    """Draw a turn about the vertical within +-`widest` [rad]: a quaternion, wxyz."""
    return turn_left(rng.uniform(-widest, widest))


def turn_left(yaw: float) -> F64:
    """Return the quaternion, wxyz (4,), of a turn about the vertical [rad]."""
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def product(first: F64, second: F64) -> F64:
    """Return the product of two quaternions, wxyz (4,)."""
    turn = np.empty(4)
    mujoco.mju_mulQuat(turn, first, second)
    return turn


def draw_until[T](draw: Callable[[], T], fits: Callable[[T], bool], world: World, what: str) -> T:
    """Return the first draw that fits.

    Args:
        draw: Draws a candidate.
        fits: Returns whether a candidate fits.
        world: The world, whose task and robot an error names.
        what: What is drawn, which an error names.

    Raises:
        UsageError: If none of a thousand draws fits.
    """
    for _ in range(_MOST_DRAWS):
        drawn = draw()
        if fits(drawn):
            return drawn
    raise UsageError(
        f"task {world.scene.task.name}: none of {_MOST_DRAWS} places drawn for {what} fits within"
        f" reach of {world.robot.name}; choose another task or robot"
    )


def draw_few(draw: Callable[[], F64], fits: Callable[[F64], bool]) -> F64 | None:
    """Return the first of a few draws, (d,), that fits; None if none does, and others must be
    redrawn.
    """
    drawn = (draw() for _ in range(FEW_DRAWS))
    return next((place for place in drawn if fits(place)), None)


def resting_height(world: World, name: str) -> float:
    """Return the height of an object's centre over the table in its modelled orientation [m]."""
    return world.extents(name)[2] / 2


def draw_xy(rng: np.random.Generator, world: World) -> F64:
    """Draw x and y in the workspace, (2,) [m]."""
    space = world.robot.workspace
    return np.array(space.centre) + rng.uniform(-1, 1, 2) * space.half_width
