"""What an arm of one's own can do before anything is recorded: gripper, reach, starts, the expert at every task."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.errors import UsageError
from manip_il.evaluation.results import EpisodeResult, EvalResult
from manip_il.evaluation.runner import HOLD, evaluate
from manip_il.evaluation.suites import read_condition
from manip_il.robots.reach import reach_of
from manip_il.robots.robot import Robot
from manip_il.robots.table import get_robot
from manip_il.seeding import rng_for, stream_seeds
from manip_il.sim.conditions import NOMINAL
from manip_il.sim.home import Pair, meeting_at
from manip_il.sim.scene import PREFIX
from manip_il.sim.task import Task
from manip_il.sim.variation import widest_grasp
from manip_il.sim.world import World
from manip_il.tasks.config import make_config
from manip_il.tasks.envs import scene_of
from manip_il.tasks.table import get_task

FILE_NAME = "check.json"
SOLVES = 0.9  # share of clean episodes that the expert solves, of a task that can be done
STARTS = 50  # of each task that are drawn
ENOUGH = 0.95  # share of a workspace that a robot reaches, of one that suits it
LOW = 0.03  # height of what lies on the table [m]
_FEW = 3  # starts without a place, after which no more are drawn
_NARROWER = 0.01  # steps in which a smaller workspace is tried [m]


@dataclass(frozen=True)
class TaskCheck:
    """One task with a robot.

    widths: of what is grasped [m]. refused: why there is no scene, or why a start found no place; else empty. found,
    drawn: starts. objects, goals: where on the table they are, x and y [m]; goals are those and the furniture. clean,
    noisy: evaluations of the expert, as it is and with a tenth of its actions random; None if none ran.
    """

    name: str
    widths: Mapping[str, float]
    refused: str = ""
    found: int = 0
    drawn: int = 0
    objects: tuple[tuple[float, float], ...] = ()
    goals: tuple[tuple[float, float], ...] = ()
    clean: EvalResult | None = None
    noisy: EvalResult | None = None

    @property
    def has_starts(self) -> bool:
        """Whether every start that was drawn found a place."""
        return 0 < self.found == self.drawn

    @property
    def done(self) -> bool:
        """Whether the robot can do it."""
        return self.has_starts and (self.clean is None or self.clean.success.rate >= SOLVES)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        starts = {"found": self.found, "drawn": self.drawn} if self.drawn else None
        facts = {"widths": dict(self.widths), "refused": self.refused, "starts": starts}
        return {"task": self.name, "done": self.done} | facts | {"clean": _json(self.clean), "noisy": _json(self.noisy)}


@dataclass(frozen=True)
class RobotCheck:
    """A robot as it was measured. name: as it was given.

    opening: the widest of the gripper [m]. overlaps: pairs of links at home, and in any posture. table: share of points
    on the table of the workspace that the hand, pointing down, gets to. half_width: the widest at which a share of
    `ENOUGH` of the table is reached [m]; 0 if there is none.
    """

    name: str
    robot: Robot
    opening: float
    overlaps: tuple[Pair, ...]
    table: float
    half_width: float
    tasks: tuple[TaskCheck, ...]

    @property
    def failed(self) -> tuple[TaskCheck, ...]:
        """Tasks that cannot be done."""
        return tuple(task for task in self.tasks if not task.done)

    def to_json(self) -> dict[str, Any]:
        """Return the contents of `check.json`."""
        return {
            "robot": self.name,
            "hand": self.robot.hand,
            "gripper": {"joints": self.robot.gripper.joints, "opening": self.opening},
            "home_overlaps": self.overlaps,
            "reach": {"table": self.table, "half_width": self.half_width},
            "tasks": [task.to_json() for task in self.tasks],
        }


def check_robot(
    name: str, tasks: Sequence[str], episodes: int, engine: Engine, on_result: Callable[[EpisodeResult], object]
) -> RobotCheck:
    """Measure a robot, by its name or YAML, with tasks. episodes: of each task, clean and as many with random actions.

    on_result: called with every episode's result as it ends. Raises `UsageError` if the robot itself cannot be used.
    """
    robot, scene = get_robot(name), scene_of(name, "reach")
    overlaps = tuple(meeting_at(robot, scene.model, PREFIX, np.asarray(robot.home)))
    checked = [check_starts(name, task) for task in tasks]
    for place, task in enumerate(checked):
        if episodes and task.has_starts:
            found: list[EvalResult] = []
            for condition in (NOMINAL, read_condition("random_actions")):
                job = RolloutJob(make_config(name, task.name), hold=HOLD, label="last", conditions=(condition,))
                seeds = stream_seeds("validation", episodes)
                found.append(evaluate(engine, job, seeds, "expert", on_result, suite=condition.name))
            checked[place] = replace(task, clean=found[0], noisy=found[1])
    return RobotCheck(name, robot, scene.gripper.most, overlaps, *reach_facts(robot), tasks=tuple(checked))


def check_starts(name: str, task: str) -> TaskCheck:
    """Draw a task's starts with a robot as episodes do; stops after a few that find no place."""
    the_task = get_task(task)
    checked = TaskCheck(task, widths(the_task))
    try:
        scene = scene_of(name, task)
    except UsageError as error:
        return replace(checked, refused=str(error))
    world = World(scene)
    world.update()
    objects, goals, why, found, drawn = list[tuple[float, float]](), list[tuple[float, float]](), "", 0, 0
    for seed in stream_seeds("validation", STARTS):
        if drawn - found == _FEW:
            break
        drawn += 1
        try:
            poses = the_task.draw(rng_for(seed, "reset"), world).poses
        except UsageError as error:
            why = str(error)
            continue
        found += 1
        for thing, (at, _) in poses.items():
            (objects if thing in scene.objects else goals).append((float(at[0]), float(at[1])))
    return replace(checked, refused=why, found=found, drawn=drawn, objects=tuple(objects), goals=tuple(goals))


def widths(task: Task) -> dict[str, float]:
    """Return how wide the objects that a task grasps are between fingers from above, by name [m]."""
    spec = mujoco.MjSpec()
    task.build(spec)
    model, found = spec.compile(), dict[str, float]()
    for name in task.grasped:
        geom = int(model.body(name).geomadr[0])
        found[name] = widest_grasp(int(model.geom_type[geom]), model.geom_size[geom])
    return found


def reach_facts(robot: Robot) -> tuple[float, float]:
    """Return `table` and `half_width` of a `RobotCheck`; takes seconds if the map of the reach is not kept yet."""
    reach, (x, y), half_width = reach_of(robot), robot.workspace.centre, robot.workspace.half_width

    def share(half: float) -> float:
        steps = np.linspace(-half, half, 41).tolist()
        return float(np.mean([reach.has((x + dx, y + dy, LOW)) for dx in steps for dy in steps]))

    narrower = np.arange(half_width, 0.0, -_NARROWER).tolist()
    return share(half_width), round(next((half for half in narrower if share(half) >= ENOUGH), 0.0), 3)


def _json(result: EvalResult | None) -> dict[str, Any] | None:
    if result is None:
        return None
    success = result.success
    return {
        "successes": success.successes,
        "n": success.n,
        "interval": success.interval,
        "failures": result.failures,
    }
