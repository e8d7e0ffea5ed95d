"""Free objects, furniture and goal markers that tasks put on the table, and what is observed of
objects and hand.
"""

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

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
