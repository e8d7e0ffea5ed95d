"""Where hand, object and goal truly were in a recorded state, whatever a policy was shown."""

from __future__ import annotations

from functools import cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import State
from manip_il.sim.scene import build_scene

Places = dict[str, list[float]]


def places(robot: str, task: str, sim_state: NDArray[np.float64]) -> Places:
    """`hand`, `object` (where the task has one) and `goal` [m] of one row of `sim_state` (m,)."""
    scene, data = build_scene(robot, task), _data(robot, task)
    state = State.from_vector(sim_state)
    data.qpos[:] = state.physics[scene.qpos_slice]
    mujoco.mj_kinematics(scene.model, data)
    found = {"hand": data.site_xpos[scene.ee_site], "goal": state.goal}
    if scene.object_q is not None:
        found["object"] = data.qpos[scene.object_q : scene.object_q + 3]
    return {name: [round(float(value), 4) for value in at] for name, at in found.items()}


@cache
def _data(robot: str, task: str) -> Any:
    return mujoco.MjData(build_scene(robot, task).model)
