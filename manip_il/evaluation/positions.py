"""Where things truly were in a state, for the results of an evaluation."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import State
from manip_il.sim.config import EnvConfig
from manip_il.sim.scene import SCENES_KEPT, build_scene
from manip_il.sim.world import World
from manip_il.stock.simulation import StockSimulation
from manip_il.stock.table import ROBOT as STOCK
from manip_il.tasks.table import get_task
from manip_il.tasks.task import objects_in

_world = lru_cache(SCENES_KEPT)(World)


def positions(env: EnvConfig, sim_state: NDArray[np.float64]) -> dict[str, list[float]]:
    """Return the true positions [m] in one row of `sim_state` (m,): `hand`, objects, and `goal`.

    The first object that the episode is about is called `object`; `goal` is where it, or the hand, is to go.
    """
    state = State.from_vector(sim_state)
    found = StockSimulation().positions(env, state) if env.robot == STOCK else _positions(env, state)
    return {name: [round(float(value), 4) for value in at] for name, at in found.items()}


def _positions(env: EnvConfig, state: State) -> dict[str, NDArray[np.float64]]:
    world, task = _world(build_scene(env.robot, env.task, env.object)), get_task(env.task, env.object)
    world.restore(state.physics, state.variation)
    found = {"hand": world.ee.position, "goal": task.destination(world)}
    for name in world.scene.objects:
        found["object" if name in objects_in(task, world)[:1] else name] = world.pose(name).position
    return found
