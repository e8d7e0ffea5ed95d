"""What the gripper opens to at each command, and what of the tasks' objects fits between its fingers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco

from manip_il.robots.gripper import sweep
from manip_il.robots.robot import Robot
from manip_il.sim.variation import widest_grasp
from manip_il.tasks.task import Task


@dataclass(frozen=True)
class HandFacts:
    """A gripper from closed to open.

    joints: the driven ones, and where they stand closed and open [m] or [rad]. commands: those of the first joint [m]
    or [rad], and the opening measured at each, rising [m]. jaw: whether one jaw alone moves.
    """

    joints: tuple[str, ...]
    closed: tuple[float, ...]
    open: tuple[float, ...]
    commands: tuple[float, ...]
    openings: tuple[float, ...]
    jaw: bool

    @property
    def most(self) -> float:
        """The widest opening [m]."""
        return self.openings[-1]


def hand_facts(robot: Robot) -> HandFacts:
    """Return the measured openings of a robot's gripper."""
    measured, config = sweep(robot), robot.gripper
    closed, travel = config.closed[0], config.open[0] - config.closed[0]
    return HandFacts(
        joints=config.joints,
        closed=config.closed,
        open=config.open,
        commands=tuple(float(closed + share * travel) for share in measured.shares),
        openings=tuple(measured.openings.tolist()),
        jaw=bool(measured.middles.any()),
    )


def widths(task: Task) -> Mapping[str, float]:
    """Return how wide the objects that a task grasps are between fingers from above, by name [m]."""
    spec = mujoco.MjSpec()
    task.build(spec)
    model, found = spec.compile(), dict[str, float]()
    for name in task.grasped:
        geom = int(model.body(name).geomadr[0])
        found[name] = widest_grasp(int(model.geom_type[geom]), model.geom_size[geom])
    return found
