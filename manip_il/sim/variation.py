"""How a world differs from the compiled model, as numbers that a state holds.

First five numbers per object: MuJoCo's `geom_size` (3,) [m], the mass [kg] and the sliding
friction. Then the numbers of the world as a whole, such as `table` and `clutter`, with the names
and units of `Condition`.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np

from manip_il.mdp import F64, I64
from manip_il.sim.conditions import OWN, RANGES
from manip_il.sim.config import CAMERAS
from manip_il.sim.shape import ObjectShape, contact

GEOMS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}
KINDS = {int(geom): kind for kind, geom in GEOMS.items()}
MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
PER_OBJECT = 5
_SIZE = slice(0, 3)
_MASS = 3
_FRICTION = 4
_SHAPE = 0  # the place after the objects' numbers: `OWN`, or MuJoCo's geom type if a shape is drawn
WORLD_SIZE = 1 + sum(len(quantity.places) for quantity in RANGES.values())
NOTHING_DRAWN = np.full(WORLD_SIZE, OWN)  # the world's numbers, (w,)
for _quantity in RANGES.values():
    NOTHING_DRAWN[_quantity.places] = _quantity.nominal
# numbers for how the episode began and how it looks
_NOT_PHYSICS = WORLD_SIZE - RANGES["posture"].places[0]


class Object(NamedTuple):
    """A free body of a compiled model, and its first geom, which gives its shape.

    Attributes:
        name: Name of the body.
        body: Id of the body.
        geom: Id of the geom.
        q: Where its free joint starts in `qpos`.
        v: Where its free joint starts in `qvel`.
    """

    name: str
    body: int
    geom: int
    q: int
    v: int


def nominal(model: mujoco.MjModel, objects: Mapping[str, Object]) -> F64:
    """Return the variation of a model as compiled, (v,)."""
    rows = [
        [*model.geom_size[one.geom], model.body_mass[one.body], model.geom_friction[one.geom, 0]]
        for one in objects.values()
    ]
    return np.concatenate([*rows, NOTHING_DRAWN])


def part(variation: F64, name: str) -> F64:
    """Return the numbers of one quantity in a variation.

    Args:
        variation: The variation, (v,).
        name: A name in `RANGES`, such as `table` or `clutter`.
    """
    return _world(variation)[RANGES[name].places]


def seen_objects(variation: F64) -> tuple[F64, int | None]:
    """Return the sizes of all objects and their shape.

    Args:
        variation: The variation, (v,).

    Returns:
        `geom_size` of each object, (o, 3) [m], and MuJoCo's geom type of all, None unless a shape
        was drawn.
    """
    shape = float(_world(variation)[_SHAPE])
    return _objects(variation)[:, _SIZE], None if shape == OWN else int(shape)


def _world(variation: F64) -> F64:
    return variation[len(variation) - WORLD_SIZE :]


def _objects(variation: F64) -> F64:
    return variation[: len(variation) - WORLD_SIZE].reshape(-1, PER_OBJECT)


def same_physics(variation: F64, other: F64) -> bool:
    """Return whether two variations (v,) of a scene have the same physics."""
    return np.array_equal(variation[:-_NOT_PHYSICS], other[:-_NOT_PHYSICS])


def with_drawn(base: F64, drawn: Mapping[str, Any]) -> F64:
    """Return a variation with the values that a condition drew, (v,).

    An object of a drawn shape has the mass of a wooden one, unless a mass is drawn.

    Args:
        base: The variation to start from, (v,).
        drawn: Values, by the names and in the units of `Condition`; size is the edge or width [m],
            and camera_shift and camera_turn have a vector (3,) per camera. Names of other
            quantities change nothing.
    """
    varied = base.copy()
    world = _world(varied)
    if kind := drawn.get("shape"):
        world[_SHAPE] = GEOMS[kind]
    for row in _objects(varied):
        width = 2 * float(row[_SIZE].max())
        size = drawn.get("size", width)
        if kind:
            shape = ObjectShape.of_width(kind, size)
            row[:_FRICTION] = [*shape.size, 0.0, 0.0][:_MASS] + [shape.mass]
        else:
            row[_SIZE] *= size / width
        row[_MASS] = drawn.get("mass", row[_MASS])
        row[_FRICTION] = drawn.get("friction", row[_FRICTION])
    for name in RANGES.keys() & drawn:
        value = drawn[name]
        if isinstance(value, dict):
            value = np.concatenate([value[camera] for camera in CAMERAS])
        world[RANGES[name].places] = value
    return varied


def apply(
    model: Any,
    plain: mujoco.MjModel,
    objects: Mapping[str, Object],
    motors: I64,
    variation: F64,
) -> None:
    """Apply a variation to the objects and the arm of a model that is not shared.

    Call `mj_setConst` afterwards: it updates what depends on masses.

    Args:
        model: The model, changed in place.
        plain: The model as compiled.
        objects: The model's objects, by name, in the order of the variation.
        motors: Ids of the actuators of the arm's joints, (arm,).
        variation: The variation, (v,).
    """
    # kv changes by the square root of kp's factor, which keeps the damping ratio.
    damping, gain = part(variation, "joint_damping"), part(variation, "actuator_gain")
    dofs = plain.jnt_dofadr[plain.actuator_trnid[motors, 0]]
    model.dof_damping[dofs] = plain.dof_damping[dofs] * damping
    model.actuator_gainprm[motors, 0] = plain.actuator_gainprm[motors, 0] * gain  # kp
    model.actuator_biasprm[motors, 1] = plain.actuator_biasprm[motors, 1] * gain  # -kp
    model.actuator_biasprm[motors, 2] = plain.actuator_biasprm[motors, 2] * np.sqrt(gain)  # -kv
    _, shape = seen_objects(variation)
    for one, row in zip(objects.values(), _objects(variation), strict=True):
        _apply_object(model, plain, one, row, shape)


def _apply_object(changed: Any, plain: Any, one: Object, row: F64, shape: int | None) -> None:
    geom, body = one.geom, one.body
    size, (mass, friction) = row[_SIZE], row[_MASS:]
    own = int(plain.geom_type[geom])
    kind = own if shape is None else shape
    for name in ("geom_condim", "geom_friction"):
        getattr(changed, name)[geom] = getattr(plain, name)[geom]
    if shape is not None:
        changed.geom_condim[geom], changed.geom_friction[geom, 2] = contact(KINDS[shape])
    nodes = slice(plain.body_bvhadr[body], plain.body_bvhadr[body] + plain.body_bvhnum[body])
    like, at = plain, geom
    bounds = plain.bvh_aabb[nodes, 3:]
    inertia = plain.body_inertia[body] * (mass / plain.body_mass[body])
    if own != MESH and (kind != own or not np.array_equal(size, plain.geom_size[geom])):
        spec = mujoco.MjSpec()  # a body of one geom, for its inertia and bounds
        spec.worldbody.add_body().add_geom(type=mujoco.mjtGeom(kind), size=size, mass=mass)
        like, at = spec.compile(), 0
        inertia = like.body_inertia[1]
        bounds = np.maximum(like.geom_aabb[0, 3:], bounds if plain.body_geomnum[body] > 1 else 0.0)
    for name in ("geom_type", "geom_size", "geom_rbound", "geom_aabb"):
        getattr(changed, name)[geom] = getattr(like, name)[at]
    changed.bvh_aabb[nodes, 3:] = bounds
    changed.body_mass[body], changed.body_inertia[body] = mass, inertia
    # MuJoCo uses the larger friction of two touching geoms unless one has priority; a drawn
    # friction gets it.
    changed.geom_friction[geom, 0] = friction
    changed.geom_priority[geom] = (
        plain.geom_priority[geom] or friction != plain.geom_friction[geom, 0]
    )
