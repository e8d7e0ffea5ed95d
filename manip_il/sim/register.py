"""Names for gymnasium: `manip_il/PandaPickPlace-v0` and its siblings."""

from __future__ import annotations

import gymnasium

from manip_il.robots.robot import ROBOTS
from manip_il.tasks.table import TASKS

ENV_IDS = {
    f"manip_il/{''.join(part.capitalize() for part in f'{robot}_{task}'.split('_'))}-v0": (robot, task)
    for robot in ROBOTS
    for task in TASKS
}


def register_envs() -> None:
    """Register every robot and task with gymnasium; a second call changes nothing."""
    for env_id, (robot, task) in ENV_IDS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, entry_point="manip_il.sim.env:ManipEnv", kwargs={"robot": robot, "task": task})
