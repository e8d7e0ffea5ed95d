"""Free objects, furniture and goal markers that tasks put on the table, what is observed of
objects and hand, and random starts within an arm's reach.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco import mjtGeom

from manip_il.errors import UsageError
from manip_il.mdp import F64
from manip_il.sim.mesh import Mesh
from manip_il.sim.shape import ANY, MESH, contact
from manip_il.sim.task import Observed
from manip_il.sim.variation import GEOMS
from manip_il.sim.world import GOAL, World
from manip_il.tasks.grasp import is_cube, lie_of

Colour = tuple[float, ...]  # red, green and blue, 0 to 1
CUBE_HALF = 0.025  # [m]
CUBE_MASS = 0.1  # [kg]
MOST_HULL = 500  # vertices of a mesh's collision hull: finer ones take seconds to compile
FRICTION = 1.0  # sliding friction against anything
RED = (0.86, 0.24, 0.16)
BLUE = (0.16, 0.40, 0.80)
YELLOW = (0.93, 0.72, 0.16)
WOOD = (0.52, 0.37, 0.25)
GREY = (0.45, 0.47, 0.50)
_GREEN = (0.12, 0.72, 0.35, 0.55)
SHAPES = {**GEOMS, ANY: GEOMS["box"], MESH: mujoco.mjtGeom.mjGEOM_MESH}


def add_cube(
    spec: mujoco.MjSpec,
    name: str,
    half: float = CUBE_HALF,
    mass: float = CUBE_MASS,
    colour: Colour = RED,
) -> None:
    """Add a free cube.

    Args:
        spec: The scene to add it to.
        name: The name of its body, joint, geom and material.
        half: Half the length of its edges [m].
        mass: Its mass [kg].
        colour: Red, green and blue, 0 to 1.
    """
    add_object(spec, name, "box", [half] * 3, mass, colour)


def add_object(
    spec: mujoco.MjSpec,
    name: str,
    shape: str,
    size: Sequence[float],
    mass: float,
    colour: Colour,
    mesh: Mesh | None = None,
) -> None:
    """Add a free object.

    Args:
        spec: The scene to add it to.
        name: The name of its body, joint, geom and material.
        shape: A key of `SHAPES`.
        size: MuJoCo's `geom_size` for this shape, (1,) to (3,) [m].
        mass: Its mass [kg].
        colour: Red, green and blue, 0 to 1.
        mesh: Its surface, which replaces `size`, if the shape is a mesh.
    """
    material = spec.add_material(name=name, rgba=[*colour, 1], specular=0.3, shininess=0.5)
    body = spec.worldbody.add_body(name=name, pos=[0.5, 0, max(size)])
    body.add_freejoint(name=name)
    condim, rolling = contact(shape)
    geom = body.add_geom(
        name=name,
        type=SHAPES[shape],
        mass=mass,
        material=material.name,
        condim=condim,
        friction=[FRICTION, 0.02, rolling],
        solimp=[0.95, 0.99, 0.001, 0.5, 2],
        solref=[0.01, 1],
    )
    if mesh is None:
        geom.size[: len(size)] = size
        return
    drawn = spec.add_mesh(name=name, uservert=mesh.vertices.ravel(), maxhullvert=MOST_HULL)
    drawn.userface, drawn.inertia = mesh.faces.ravel(), mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT
    geom.meshname = name


def add_furniture(spec: mujoco.MjSpec, name: str) -> Any:
    """Return a new mocap body for solid parts; its pose is set at the start of an episode."""
    return spec.worldbody.add_body(name=name, mocap=True, pos=[0.5, 0, 0])


def add_part(
    body: Any,
    name: str,
    half: Sequence[float],
    at: Sequence[float],
    colour: Colour = WOOD,
) -> Any:
    """Add a solid box to a body and return its geom.

    Args:
        body: The body to add it to.
        name: The name of its geom.
        half: Half its lengths, (3,) [m].
        at: Its middle in the body's frame, (3,) [m].
        colour: Red, green and blue, 0 to 1.
    """
    return body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=list(half),
        pos=list(at),
        rgba=[*colour, 1],
        friction=[0.6, 0.005, 0.0001],
        mass=1000 * 8 * float(np.prod(half)),
    )


def add_sides(
    body: Any,
    name: str,
    half: Sequence[float],
    at: Sequence[float],
    colour: Colour = WOOD,
) -> None:
    """Add two solid boxes, `NAME left` and `NAME right`, which mirrors it in y.

    Args:
        body: The body to add them to.
        name: The name of their geoms, before the side.
        half: Half the lengths of each, (3,) [m].
        at: The middle of the left one in the body's frame, (3,) [m].
        colour: Red, green and blue, 0 to 1.
    """
    x, y, z = at
    add_part(body, f"{name} left", half, at, colour)
    add_part(body, f"{name} right", half, (x, -y, z), colour)


def add_goal(spec: mujoco.MjSpec, *, flat: bool = False) -> None:
    """Add a goal marker without contacts.

    It is a mocap body, so that lockstep environments can share one model.

    Args:
        spec: The scene to add it to.
        flat: Whether the marker is a disc on the table and not a ball in the air.
    """
    material = spec.add_material(name=GOAL, rgba=list(_GREEN), specular=0.0, emission=0.4)
    body = spec.worldbody.add_body(name=GOAL, mocap=True, pos=[0.5, 0, 0.2])
    shape = mujoco.mjtGeom.mjGEOM_CYLINDER if flat else mujoco.mjtGeom.mjGEOM_SPHERE
    size = [0.03, 0.001, 0] if flat else [0.02, 0, 0]
    body.add_geom(
        name=GOAL, type=shape, size=size, material=material.name, contype=0, conaffinity=0, mass=0
    )


def observe_hand(world: World) -> Observed:
    """Return the hand's position and its y and z axes.

    They are the first entries of every `environment_state`.
    """
    ee = world.ee
    return {"ee": ee.position, "ee.axis_y": ee.rotation[:, 1], "ee.axis_z": ee.rotation[:, 2]}


def observe_object(world: World, name: str, known_as: str = "") -> Observed:
    """Return an object's pose and lengths, and the vector to it from the hand.

    The pose is its position, its yaw modulo its symmetry, and its tilt.

    Args:
        world: The world to look at.
        name: The object's name.
        known_as: The name of the object in what is returned, by default its own.
    """
    known_as = known_as or name
    position, lie = world.at(name), lie_of(world, name)
    only_cubes = not world.scene.draws_shape and is_cube(world, name)
    folds = "4" if only_cubes else ""
    # numbers of the narrowest grasp change continuously as the object turns
    yaw, width, length, centre = min(lie.grasps, key=lambda grasp: grasp[1])
    seen: dict[str, F64 | float] = {
        f"cos{folds}yaw": math.cos(lie.folds * yaw),
        f"sin{folds}yaw": math.sin(lie.folds * yaw),
        "tilt": lie.tilt,
        "width": width,
    }
    if not only_cubes:
        seen = {"folds": float(lie.folds), **seen, "length": length, "height": lie.tall}
    if world.hull(name) is not None:
        seen["grasp"] = np.array(centre)
    return {
        known_as: position,
        **{f"{known_as}.{key}": value for key, value in seen.items()},
        f"{known_as}_from_ee": position - world.ee.position,
    }


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
