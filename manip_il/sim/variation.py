"""Parameters of the model that may differ from episode to episode, as numbers that a state holds.

Five for every object: half its lengths along its own axes [m], its mass [kg] and its sliding friction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError, MismatchError

F64 = NDArray[np.float64]
PER_OBJECT = 5
_SIZE, _MASS, _FRICTION = slice(0, 3), 3, 4


@dataclass(frozen=True)
class Object:
    """A free body of a compiled model and its one geom. q, v: starts of its free joint in qpos and qvel."""

    name: str
    body: int
    geom: int
    q: int
    v: int


def nominal(model: mujoco.MjModel, objects: Mapping[str, Object]) -> F64:
    """Return the variation that a compiled model has, (v,)."""
    parts = [
        np.concatenate([model.geom_size[one.geom], [model.body_mass[one.body], model.geom_friction[one.geom, 0]]])
        for one in objects.values()
    ]
    return np.concatenate(parts) if parts else np.empty(0)


def check(variation: F64, like: F64) -> None:
    """Raise `MismatchError` for a variation of another length than the scene's (v,), `ManipError` for a wrong one."""
    if variation.shape != like.shape:
        raise MismatchError("size of the variation", "the state", len(variation), "the scene", len(like))
    if (variation[like > 0] <= 0).any():
        raise ManipError(f"a variation of {variation}; expected lengths, masses and frictions above 0")


def with_drawn(base: F64, drawn: Mapping[str, Any]) -> F64:
    """Return a variation (v,) with values by the names of `Condition`: size (edge [m]), mass [kg], friction."""
    rows = base.copy().reshape(-1, PER_OBJECT)
    if "size" in drawn:
        rows[:, _SIZE] *= (drawn["size"] / 2 / rows[:, _SIZE].max(axis=1))[:, None]
    if "mass" in drawn:
        rows[:, _MASS] = drawn["mass"]
    if "friction" in drawn:
        rows[:, _FRICTION] = drawn["friction"]
    return rows.reshape(-1)


def apply(model: mujoco.MjModel, plain: mujoco.MjModel, objects: Mapping[str, Object], variation: F64) -> None:
    """Give the objects of a model that nobody else uses the lengths, masses and frictions of `variation` (v,).

    plain: the model as compiled. Call `mj_setConst` afterwards, for what follows from masses.
    """
    changed: Any = model
    for one, row in zip(objects.values(), variation.reshape(-1, PER_OBJECT), strict=True):
        size, mass, friction = row[_SIZE], float(row[_MASS]), float(row[_FRICTION])
        before = plain.geom_size[one.geom]
        changed.geom_size[one.geom] = size
        extent = extents(int(plain.geom_type[one.geom]), size)
        changed.geom_rbound[one.geom] = _bound(int(plain.geom_type[one.geom]), size)
        changed.geom_aabb[one.geom, 3:] = extent / 2
        for node in range(plain.body_bvhadr[one.body], plain.body_bvhadr[one.body] + plain.body_bvhnum[one.body]):
            changed.bvh_aabb[node, 3:] = extent / 2
        if np.array_equal(size, before):
            inertia = plain.body_inertia[one.body] * (mass / plain.body_mass[one.body])
        else:
            inertia = _inertia(int(plain.geom_type[one.geom]), size, mass)
        changed.body_mass[one.body], changed.body_inertia[one.body] = mass, inertia
        # Of two geoms that touch, the larger friction counts unless one has priority: here the drawn one counts.
        drawn = friction != plain.geom_friction[one.geom, 0]
        changed.geom_friction[one.geom, 0] = friction
        changed.geom_priority[one.geom] = 1 if drawn else plain.geom_priority[one.geom]


def extents(kind: int, size: F64) -> F64:
    """Return the lengths of a geom along its own axes [m], (3,), from MuJoCo's `geom_size`."""
    geom = mujoco.mjtGeom
    if kind == int(geom.mjGEOM_BOX):
        return 2 * size
    if kind == int(geom.mjGEOM_SPHERE):
        return np.full(3, 2 * size[0])
    if kind == int(geom.mjGEOM_CYLINDER):
        return 2 * np.array([size[0], size[0], size[1]])
    if kind == int(geom.mjGEOM_CAPSULE):
        return 2 * np.array([size[0], size[0], size[1] + size[0]])
    raise ManipError(f"an object of MuJoCo's geom type {kind}; expected a box, sphere, cylinder or capsule")


def widest_grasp(kind: int, size: F64) -> float:
    """Return how wide a geom is between fingers from above, on whichever side it lies [m]."""
    lengths = np.sort(extents(kind, size))
    return float(lengths[1] if kind == int(mujoco.mjtGeom.mjGEOM_BOX) else extents(kind, size)[0])


def _bound(kind: int, size: F64) -> float:
    """Return the radius of the sphere around a geom [m]."""
    if kind == int(mujoco.mjtGeom.mjGEOM_BOX):
        return float(np.linalg.norm(size))
    if kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER):
        return float(np.hypot(size[0], size[1]))
    return float(extents(kind, size).max() / 2)


def _inertia(kind: int, size: F64, mass: float) -> F64:
    """Return the principal moments of a solid geom [kg m^2], (3,); a capsule's as a cylinder's of its length."""
    x, y, z = extents(kind, size)
    if kind == int(mujoco.mjtGeom.mjGEOM_BOX):
        return mass / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    if kind == int(mujoco.mjtGeom.mjGEOM_SPHERE):
        return np.full(3, mass * x * x / 10)
    across = mass / 12 * (3 * x * x / 4 + z * z)
    return np.array([across, across, mass * x * x / 8])
