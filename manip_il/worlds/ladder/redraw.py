"""New scenes from visited states: new goals, and new places of untouched objects."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import F64, State
from manip_il.sim.world import World

# shares: new goals, moved objects, moved objects placed near the hand
GOALS = 0.8
OBJECTS = 0.7
NEAR = 0.5
_UNTOUCHED = 0.04  # least distance of an untouched object's centre from the hand [m]
_AROUND = 0.04  # standard deviation of an object's place near the hand, in x and y [m]
_DEEP = 1e-3  # largest overlap of a moved object with another [m]


def redrawn(world: World, visited: State, rng: np.random.Generator) -> State | None:
    """Return a scene with new goals and new places of untouched objects; None if the drawn places overlap.

    world: restored and changed.
    """
    task = world.scene.task
    world.restore(visited.physics, visited.variation)
    free, markers = _untouched(world), _markers(world.model)
    poses = task.draw(rng, world).poses
    new_goals, moved = rng.uniform() < GOALS, list[int]()
    for name, (at, turn) in poses.items():
        body = world.scene.model.body(name).id
        if name in task.argument_bodies:
            continue
        if body in markers:
            if new_goals:
                world.place(name, at, turn)
        elif body in free and rng.uniform() < OBJECTS:
            near = name in world.scene.objects and rng.uniform() < NEAR
            world.place(name, _near_hand(world, at, rng) if near else at, turn)
            moved.append(body)
    world.update()
    roots, depths = _contacts(world)
    overlaps = np.isin(roots, moved).any(axis=1) & (roots[:, 0] != roots[:, 1]) & (depths > _DEEP)
    return None if overlaps.any() else replace(visited, physics=world.physics())


def _untouched(world: World) -> set[int]:
    """Return bodies of objects and furniture that are at rest and touch only what is fixed to the world."""
    model, (roots, _) = world.model, _contacts(world)
    touched = set(roots[(roots > 0).all(axis=1) & (roots[:, 0] != roots[:, 1])].ravel().tolist())
    ee = world.ee.position.tolist()
    free = {
        one.body
        for name, one in world.scene.objects.items()
        if world.at_rest(name) and math.dist(world.pose(name).position.tolist(), ee) > _UNTOUCHED
    }
    return (free | {body for body in range(model.nbody) if model.body_mocapid[body] >= 0}) - touched


@lru_cache(1)
def _markers(model: mujoco.MjModel) -> set[int]:
    """Return the bodies that mark goals: mocap bodies without collisions."""
    solid = set(model.body_rootid[model.geom_bodyid[model.geom_contype > 0]].tolist())
    return {body for body in range(model.nbody) if model.body_mocapid[body] >= 0 and body not in solid}


def _near_hand(world: World, at: F64, rng: np.random.Generator) -> F64:
    """Return a random place around the hand, at the height of `at`, (3,) [m]."""
    return np.append(world.ee.position[:2] + rng.normal(0.0, _AROUND, 2), at[2])


def _contacts(world: World) -> tuple[NDArray[np.int32], F64]:
    """Return the root bodies of every contact, (C, 2), and its depth [m], (C,)."""
    model, contacts = world.model, world.data.contact
    mujoco.mj_collision(model, world.data)
    return model.body_rootid[model.geom_bodyid[contacts.geom]], -contacts.dist
