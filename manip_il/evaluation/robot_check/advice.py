"""What to change in a robot's YAML, or on the command line, where something does not work: a sentence each."""

from __future__ import annotations

import math
from collections.abc import Iterator

from manip_il.evaluation.robot_check.check import SOLVES, RobotCheck, TaskCheck
from manip_il.evaluation.robot_check.joints import LOAD, JointFacts
from manip_il.evaluation.robot_check.starts import ENOUGH
from manip_il.tasks.table import get_task
from manip_il.tasks.task import TakesShape

SLOW = 0.25  # rise of a joint from which on labels run ahead of the arm [s]
SWINGS = 0.2  # share of a step by which a joint goes beyond it
SINKS = 0.005  # of the hand under the load [m]
_GRASPED = 0.6  # share of the opening that a good object fills
_ROUND = 0.005  # of an object's width [m]
_USUAL = 0.1  # rise of a joint with the gains that are found [s]


def advice(check: RobotCheck) -> tuple[str, ...]:
    """Return what to change, the robot's own first, then for each task that cannot be done."""
    return (*_of_arm(check), *_of_reach(check), *(line for task in check.failed for line in _of_task(check, task)))


def _of_arm(check: RobotCheck) -> Iterator[str]:
    for joint in check.arm.joints:
        yield from _of_joint(joint)
    if check.arm.sag > SINKS:
        weakest = max(check.arm.joints, key=lambda joint: joint.sag)
        yield (
            f"{LOAD:g} kg let the hand sink by {1000 * check.arm.sag:.0f} mm, most of it in {weakest.name}: raise its "
            f"number in gains, {weakest.kp:.3g}, or in forces, {weakest.force:.3g}."
        )
    for one, other in check.overlaps:
        yield f"{one} and {other} overlap however the arm stands: take one of the two geoms' contacts out of the model."


def _of_joint(joint: JointFacts) -> Iterator[str]:
    if joint.rise is None:
        yield f"{joint.name} does not get to its target in a second: raise its {joint.kp:.3g} in gains, or forces."
    elif joint.rise > SLOW:
        kp = joint.kp * (joint.rise / _USUAL) ** 2
        yield (
            f"{joint.name} takes {1000 * joint.rise:.0f} ms for a step: raise its number in gains from {joint.kp:.3g} "
            f"towards {kp:.2g}, or in forces."
        )
    if joint.overshoot > SWINGS:
        yield (
            f"{joint.name} goes {100 * joint.overshoot:.0f} % beyond a step: lower its {joint.kp:.3g} in gains, "
            "or raise its number in armature."
        )


def _of_reach(check: RobotCheck) -> Iterator[str]:
    space, reach = check.robot.workspace, check.reach
    if reach.table >= ENOUGH:
        return
    if reach.half_width:
        yield (
            f"The hand gets to {100 * reach.table:.0f} % of the workspace on the table; within reach is "
            f"half_width: {reach.half_width:g} in place of {space.half_width:g}."
        )
        return
    mounted = not reach.table and check.robot.gripper.files is not None
    mount = "; or turn the gripper on the hand by gripper.quaternion" if mounted else ""
    yield (
        f"The hand gets to {100 * reach.table:.0f} % of the workspace on the table, and not all around its centre: "
        f"move workspace.centre, ({space.centre[0]:g}, {space.centre[1]:g}), to where the map is green{mount}."
    )


def _of_task(check: RobotCheck, task: TaskCheck) -> Iterator[str]:
    wide = max(task.widths.values(), default=0.0)
    if wide >= check.hand.most:
        yield _too_wide(check, task.name, wide)
    elif task.refused:
        yield f"{task.name}: {task.refused}."
    elif not check.reach.table:
        return  # said of the whole workspace
    elif task.starts is not None and not task.has_starts:
        yield (
            f"{task.name}: {task.starts.drawn - task.starts.found} of {task.starts.drawn} starts find no place within "
            "reach; it needs more room than this workspace has: widen workspace.half_width where the map is green, or "
            "leave the task out."
        )
    elif task.clean is not None and task.clean.success.rate < SOLVES:
        phase, count = next(iter(task.clean.failures.items()))
        failed = task.clean.success.n - task.clean.success.successes
        yield (
            f"{task.name}: the expert fails in {failed} of {task.clean.success.n} episodes, {count} of them in the "
            f"phase {phase}; watch it: manip-il view --robot.type={check.name} --task.type={task.name}"
        )


def _too_wide(check: RobotCheck, task: str, wide: float) -> str:
    most = check.hand.most
    if isinstance(get_task(task), TakesShape):
        narrow = max(_ROUND, math.floor(_GRASPED * most / _ROUND) * _ROUND)
        change = f"choose a narrower one, --task.object=box:{narrow:.3g}, or widen gripper.open"
    else:
        change = "widen gripper.open, or leave the task out"
    return f"{task}: its object is {1000 * wide:.0f} mm wide and the gripper opens to {1000 * most:.0f} mm: {change}."
