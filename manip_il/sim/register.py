"""Names for gymnasium: `manip_il/PandaPickPlace-v0` and its siblings."""

from __future__ import annotations

import gymnasium

_ROBOTS = {"Panda": "panda", "Fetch": "fetch"}
_TASKS = {"Reach": "reach", "Lift": "lift", "PickPlace": "pick_place"}
ENV_IDS = {f"manip_il/{r}{t}-v0": (robot, task) for r, robot in _ROBOTS.items() for t, task in _TASKS.items()}


def register_envs() -> None:
    """Register every robot and task with gymnasium; a second call changes nothing."""
    for env_id, (robot, task) in ENV_IDS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, entry_point="manip_il.sim.env:ManipEnv", kwargs={"robot": robot, "task": task})
