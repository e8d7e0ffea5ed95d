"""Names for gymnasium: `manip_il/PandaPickPlace-v0` and its siblings, and `manip_il/PickPlace-v0` for any robot."""

from __future__ import annotations

import gymnasium

from manip_il.robots import ROBOTS
from manip_il.tasks import NAMES


def _id(name: str) -> str:
    return f"manip_il/{''.join(part.capitalize() for part in name.split('_'))}-v0"


ENV_IDS = {_id(f"{robot}_{task}"): (robot, task) for robot in ROBOTS for task in NAMES}
TASK_IDS = {_id(task): task for task in NAMES}  # their robot is an argument


def register_envs() -> None:
    """Register every robot and task, and every task, with gymnasium; a second call changes nothing."""
    named = {env_id: {"robot": robot, "task": task} for env_id, (robot, task) in ENV_IDS.items()}
    for env_id, kwargs in {**named, **{env_id: {"task": task} for env_id, task in TASK_IDS.items()}}.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, entry_point="manip_il.sim.env:ManipEnv", kwargs=kwargs)
