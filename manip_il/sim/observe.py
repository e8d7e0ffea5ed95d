"""What a state-based learner sees: measured joints, and the named numbers of `environment_state`."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from manip_il.sim.world import Scene, World

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]


def joint_state(world: World) -> F32:
    """Measured joint positions [rad] and gripper opening [m], float32 (n,)."""
    scene, data = world.scene, world.data
    return scene.actions.join(data.qpos[scene.arm_q], world.opening).astype(np.float32)


def environment_state(world: World) -> F32:
    """What the task shows, float32 (k,)."""
    shown = world.scene.task.observe(world).values()
    return np.concatenate([np.atleast_1d(np.asarray(value)) for value in shown]).astype(np.float32)


@cache
def environment_state_names(scene: Scene) -> tuple[str, ...]:
    """Return names of the vector's k entries; lengths in [m]."""
    world = World(scene)
    world.moved()
    names: list[str] = []
    for name, value in scene.task.observe(world).items():
        names += [f"{name}.{axis}" for axis in "xyz"] if np.ndim(value) else [name]
    return tuple(names)
