"""Visual objects without contact: the stand of a goal, and clutter around the workspace."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import turn_about_z
from manip_il.seeding import rng_for
from manip_il.sim.world import GOAL, Scene

VERSION = 3  # version of the look of these objects, part of the fingerprint of pictures
_POLE, _SHORTEST = 0.003, 0.03  # radius of a goal's pole, and its least height [m]
# radius of a goal's foot, half the length of its cross, in radii of the largest object
_FOOT, _ARM = 1.2, 1.6
_THIN, _GOAL = 0.001, 0.02  # height of a foot, radius of a goal [m]
_UP = np.eye(3)
_ACROSS = (
    np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
)  # rotations that turn z along x, and along y
_STAND = (0.10, 0.55, 0.28, 1.0)  # the stand's colour
_KINDS = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_SPHERE)
# range of a clutter object's half lengths, for a workspace as large as Panda's [m]
_HALF = (0.012, 0.04)
# least and greatest distance of clutter from the workspace's edge [m]
_BESIDE, _WITHIN = 0.06, 0.24
_FROM_BASE = 0.18  # least horizontal distance of clutter from the robot's first joint [m]
_DRAWS = 50  # draws of a clutter object's place before it is left out


class Prop(NamedTuple):
    """An object to draw.

    Attributes:
        kind: MuJoCo's geom type.
        size: MuJoCo's size of such a geom, (3,) [m].
        position: Its position in the world, (3,) [m].
        rotation: Its rotation, (3, 3).
        colour: Red, green, blue and opacity.
    """

    kind: int
    size: F64
    position: F64
    rotation: F64
    colour: tuple[float, float, float, float]

    def add_to(self, scene: Any) -> None:
        """Add the object to `scene`, MuJoCo's list of geoms to draw next."""
        geom, (*shape, rotation, colour) = scene.geoms[scene.ngeom], self
        mujoco.mjv_initGeom(geom, *shape, rotation.ravel(), np.array(colour, np.float32))
        geom.category = mujoco.mjtCatBit.mjCAT_STATIC
        scene.ngeom += 1


def props(scene: Scene, data: mujoco.MjData, clutter: Sequence[float] | F64 = (0, 0)) -> list[Prop]:
    """Return the visual objects of a scene's world.

    Args:
        scene: The scene.
        data: Its data, with up-to-date poses of mocap bodies and joints.
        clutter: Largest number of clutter objects, and the seed of their kinds and places, (2,).
    """
    return [*_stand(scene, data), *_clutter(scene, data, int(clutter[0]), int(clutter[1]))]


def _stand(scene: Scene, data: mujoco.MjData) -> list[Prop]:
    """The stand of a goal, wider than an object there: a foot on the table, or a pole with a
    cross in the air.
    """
    body = mujoco.mj_name2id(scene.model, mujoco.mjtObj.mjOBJ_BODY, GOAL)
    if body < 0:
        return []
    x, y, z = data.mocap_pos[scene.model.body_mocapid[body]].tolist()
    if z < 0:
        return []
    scale = scene.scale
    largest = max(
        (float(scene.model.geom_rbound[one.geom]) for one in scene.objects.values()),
        default=_GOAL * scale,
    )
    if z <= _SHORTEST:
        parts = [(_FOOT * largest, _THIN, _THIN / 2, _UP)]
    else:
        arms = [(_POLE * scale, 2 * _ARM * largest, z, along) for along in _ACROSS]
        parts = [(_POLE * scale, z, z / 2, _UP), *arms]
    kind = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
    return [
        Prop(kind, np.array([radius, length / 2, 0.0]), np.array([x, y, up]), rotation, _STAND)
        for radius, length, up, rotation in parts
    ]


def _clutter(scene: Scene, data: mujoco.MjData, count: int, seed: int) -> list[Prop]:
    if not count:
        return []
    rng, radii = rng_for(seed, "clutter"), scene.model.geom_rbound
    taken = [(data.geom_xpos[geom][:2].tolist(), float(radii[geom])) for geom in scene.furniture]
    found: list[Prop] = []
    for _ in range(count):
        prop, radius, height = _thing(rng, scene)
        for _ in range(_DRAWS):
            at = _place(rng, scene, data)
            if at and all(math.dist(at, other) > radius + its for other, its in taken):
                taken.append((at, radius))
                found.append(prop._replace(position=np.array([*at, height])))
                break
    return found


def _thing(rng: np.random.Generator, scene: Scene) -> tuple[Prop, float, float]:
    """A box, cylinder or ball of any colour, turned about the vertical.

    Its radius from above, half its height [m].
    """
    number = int(rng.integers(len(_KINDS)))
    x, y, z = (rng.uniform(*_HALF, 3) * scene.scale).tolist()
    size, radius, height = (
        ((x, y, z), math.hypot(x, y), z),
        ((x, z, 0.0), x, z),
        ((x, 0.0, 0.0), x, x),
    )[number]
    rotation, colour = turn_about_z(rng.uniform(-np.pi, np.pi)), rng.uniform(0.05, 0.95, 3)
    prop = Prop(int(_KINDS[number]), np.array(size), np.zeros(3), rotation, (*colour, 1.0))
    return prop, radius, height


def _place(rng: np.random.Generator, scene: Scene, data: mujoco.MjData) -> list[float]:
    """A random place on the table around the workspace.

    [] if it is in the workspace or near the robot's base.
    """
    space = scene.robot.workspace
    outer = space.half_width + _WITHIN
    x, y = rng.uniform(-outer, outer, 2).tolist()
    if max(abs(x), abs(y)) < space.half_width + _BESIDE:
        return []
    at = [space.centre[0] + x, space.centre[1] + y]
    return at if math.dist(at, data.xanchor[scene.shoulder][:2].tolist()) > _FROM_BASE else []
