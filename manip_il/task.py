"""What a task of one's own is written with: `from manip_il.task import Rung, Start, Target,
Task, World, hand_down`.
"""

from manip_il.robots.geometry import hand_down
from manip_il.sim.shape import ObjectShape
from manip_il.sim.task import Rung, Start, Target, Task
from manip_il.sim.world import GOAL, World
from manip_il.tasks.bins import add_bin, drop_place, drop_rungs, is_in
from manip_il.tasks.grasp import once_per_state
from manip_il.tasks.ladder import (
    AT_GOAL,
    CLOSED,
    LiftProfile,
    carry,
    carry_progress,
    grasp_progress,
    grasp_rungs,
    is_held,
    let_go,
    nearness,
    pick_progress,
    pick_rungs,
    rise_first,
)
from manip_il.tasks.objects import (
    UPRIGHT,
    add_cube,
    add_furniture,
    add_goal,
    add_object,
    add_part,
    draw_goal,
    draw_lying,
    draw_resting,
    draw_until,
    draw_yaw,
    observe_hand,
    observe_object,
)
from manip_il.tasks.pick_place import PickPlace

__all__ = [
    "AT_GOAL",
    "CLOSED",
    "GOAL",
    "UPRIGHT",
    "LiftProfile",
    "ObjectShape",
    "PickPlace",
    "Rung",
    "Start",
    "Target",
    "Task",
    "World",
    "add_bin",
    "add_cube",
    "add_furniture",
    "add_goal",
    "add_object",
    "add_part",
    "carry",
    "carry_progress",
    "draw_goal",
    "draw_lying",
    "draw_resting",
    "draw_until",
    "draw_yaw",
    "drop_place",
    "drop_rungs",
    "grasp_progress",
    "grasp_rungs",
    "hand_down",
    "is_held",
    "is_in",
    "let_go",
    "nearness",
    "observe_hand",
    "observe_object",
    "once_per_state",
    "pick_progress",
    "pick_rungs",
    "rise_first",
]
