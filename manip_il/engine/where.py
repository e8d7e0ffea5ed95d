"""Where hand, object and goal truly were in a recorded state, whatever a policy was shown."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import State
from manip_il.sim.scene import build_scene
from manip_il.sim.world import World

Places = dict[str, list[float]]


def places(robot: str, task: str, sim_state: NDArray[np.float64]) -> Places:
    """`hand`, objects and, where the task shows one, `goal` [m] of one row of `sim_state` (m,).

    The first object that is grasped is called `object`.
    """
    world, state = _world(robot, task), State.from_vector(sim_state)
    world.restore(state.physics, state.variation)
    found = {"hand": world.ee.position} | ({"goal": world.goal} if world.has_goal else {})
    for name in world.scene.objects:
        found["object" if name in world.scene.task.grasped[:1] else name] = world.pose(name).position
    return {name: [round(float(value), 4) for value in at] for name, at in found.items()}


@cache
def _world(robot: str, task: str) -> World:
    return World(build_scene(robot, task))
