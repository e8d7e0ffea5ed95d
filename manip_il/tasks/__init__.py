"""Tasks, one file each, and their names for gymnasium: `manip_il/PandaPickPlace-v0` and its
siblings.

`manip_il/PickPlace-v0` takes the robot as an argument, `manip_il/Task-v0` robot and task, each as a
name or file path. `NAMES` lists the tasks of `table.py`, in its order; help reads it without
importing the simulator.
"""

import gymnasium

from manip_il.robots import ROBOTS

NAMES = (
    "reach",
    "lift",
    "pick_place",
    "push",
    "press",
    "stack",
    "drawer",
    "clear_table",
    "insert",
    "insert_tight",
    "sort",
    "carry",
)
SEVERAL = ("carry:REWARD",)  # tasks with an argument after a colon


def _id(name: str) -> str:
    return f"manip_il/{''.join(part.capitalize() for part in name.split('_'))}-v0"


ENV_IDS = {_id(f"{robot}_{task}"): (robot, task) for robot in ROBOTS for task in NAMES}
TASK_IDS = {_id(task): task for task in NAMES}  # the robot is an argument
ANY_ID = "manip_il/Task-v0"  # robot and task are arguments


def register_envs() -> None:
    """Register every robot-task pair, every task and `ANY_ID` with gymnasium.

    A second call changes nothing.
    """
    named = {env_id: {"robot": robot, "task": task} for env_id, (robot, task) in ENV_IDS.items()}
    named |= {env_id: {"task": task} for env_id, task in TASK_IDS.items()} | {ANY_ID: {}}
    for env_id, kwargs in named.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id, entry_point="manip_il.worlds.ladder.world:make_env", kwargs=kwargs
            )
