"""The posture in which an episode begins, where it is drawn."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.sim.world import World

F64 = NDArray[np.float64]
_MAX_DRAWS = 100


def draw_posture(world: World, rng: np.random.Generator, largest: float) -> None:
    """Turn every arm joint, and what it is commanded, by up to `largest` [rad] from where it stands.

    The arm then touches nothing that it did not touch before, and the hand is where it gets to pointing down. The arm
    stays where it was if no such posture is drawn.
    """
    scene, data = world.scene, world.data
    low, high = (scene.actions.split(end)[0] for end in (scene.actions.low, scene.actions.high))
    before = data.qpos[scene.arm_q].copy()
    _stand(world, before)
    touching = _arm_contacts(world)
    for _ in range(_MAX_DRAWS):
        offsets = rng.uniform(-largest, largest, len(before))
        _stand(world, np.minimum(np.maximum(before + offsets, low), high))
        if _arm_contacts(world) <= touching and world.reach.has(world.ee.position):
            return
    _stand(world, before)


def _stand(world: World, q: F64) -> None:
    world.data.qpos[world.scene.arm_q] = world.data.ctrl[world.scene.arm_ctrl] = q
    world.update()
    mujoco.mj_collision(world.model, world.data)


def _arm_contacts(world: World) -> set[tuple[int, int]]:
    """Pairs of geoms in contact, of which at least one is the robot's."""
    model = world.scene.model
    robot = model.body_rootid[model.site_bodyid[world.scene.ee_site]]
    roots = model.body_rootid[model.geom_bodyid]
    pairs = world.data.contact.geom
    return {(int(a), int(b)) for a, b in pairs if robot in (roots[a], roots[b])}
