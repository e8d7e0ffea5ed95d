"""All that is measured of a robot, which tasks it can do, and what to change where it cannot."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from manip_il.child_processes import open_pool
from manip_il.collect.workers import Engine
from manip_il.data.atomic import write_file
from manip_il.errors import RenderError, UsageError
from manip_il.evaluation.episodes import EpisodeResult
from manip_il.evaluation.robot_check.episodes import ExpertFacts, expert_facts
from manip_il.evaluation.robot_check.hand import HandFacts, hand_facts, widths
from manip_il.evaluation.robot_check.joints import ArmFacts, arm_facts
from manip_il.evaluation.robot_check.pictures import Look, looks
from manip_il.evaluation.robot_check.starts import STARTS, ReachFacts, StartFacts, reach_facts, start_facts
from manip_il.robots.reach import errors_at, joined, keep_reach, kept_reach
from manip_il.robots.robot import Robot, get_robot
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import NOMINAL, Condition
from manip_il.sim.home import Pair, meeting_at
from manip_il.sim.scene import PREFIX, build_scene
from manip_il.tasks.table import get_task

FILE_NAME = "check.json"
SOLVES = 0.9  # share of clean episodes that the expert solves, of a task that can be done
_PROCESSES = 2  # that work out a map
OnResult = Callable[[EpisodeResult], object]
_PLAIN = "reach"  # the task of the scene in which the arm itself is looked at


@dataclass(frozen=True)
class TaskCheck:
    """One task with a robot.

    widths: of what is grasped [m]. refused: why there is no scene, empty where there is one; then there are no starts.
    clean, noisy: episodes of the expert, None where none ran.
    """

    name: str
    widths: dict[str, float]
    refused: str = ""
    starts: StartFacts | None = None
    clean: ExpertFacts | None = None
    noisy: ExpertFacts | None = None

    @property
    def has_starts(self) -> bool:
        """Whether every start that was drawn found a place."""
        return self.starts is not None and self.starts.found == self.starts.drawn

    @property
    def done(self) -> bool:
        """Whether the robot can do it."""
        return self.has_starts and (self.clean is None or self.clean.success.rate >= SOLVES)


@dataclass(frozen=True)
class RobotCheck:
    """A robot as it was measured. name: as it was given. overlaps: pairs of links at home, and in any posture."""

    name: str
    robot: Robot
    arm: ArmFacts
    hand: HandFacts
    overlaps: tuple[Pair, ...]
    reach: ReachFacts
    tasks: tuple[TaskCheck, ...]
    looks: tuple[Look, ...] = ()
    no_pictures: str = ""

    @property
    def failed(self) -> tuple[TaskCheck, ...]:
        """Tasks that cannot be done."""
        return tuple(task for task in self.tasks if not task.done)

    def to_json(self) -> dict[str, Any]:
        """Return all figures as plain JSON values."""
        facts = {
            "robot": self.name,
            "hand": self.robot.hand,
            "joints": [dataclasses.asdict(joint) for joint in self.arm.joints],
            "bodies": self.arm.bodies,
            "own_motors": self.arm.own_motors,
            "step": self.arm.step,
            "sag": self.arm.sag,
            "gripper": dataclasses.asdict(self.hand),
            "home_overlaps": self.overlaps,
            "reach": {key: value for key, value in dataclasses.asdict(self.reach).items() if key != "rows"},
            "tasks": [_task_json(task) for task in self.tasks],
        }
        return json.loads(json.dumps(facts))

    def write(self, path: Path) -> None:
        """Write all figures as JSON."""
        write_file(path, json.dumps(self.to_json(), indent=2).encode())


def check_robot(
    name: str, tasks: Sequence[str], episodes: int, noise: Condition, engine: Engine, on_result: OnResult
) -> RobotCheck:
    """Measure a robot, by its name or YAML, with tasks. episodes: of each task, clean and as many under `noise`.

    on_result: called with every episode's result as it ends.
    Raises `UsageError` where the robot itself cannot be used.
    """
    robot, scene = get_robot(name), build_scene(name, _PLAIN)
    with _reach_under_way(robot):
        arm, hand = arm_facts(scene), hand_facts(robot)
        overlaps = tuple(meeting_at(robot, scene.model, PREFIX, np.asarray(robot.home)))
        pictures, why = _pictures(name)
        checked = [_begin(name, task) for task in tasks]
    reach = reach_facts(robot)
    checked = [_with_starts(name, task) for task in reversed(checked)][::-1]  # the last scenes are kept still
    checked = [_with_episodes(name, task, episodes, noise, engine, on_result) for task in checked]
    return RobotCheck(name, robot, arm, hand, overlaps, reach, tuple(checked), pictures, why)


@contextlib.contextmanager
def _reach_under_way(robot: Robot) -> Generator[None]:
    """Have other processes work out a map that is not kept yet, which takes seconds, and keep it at the end."""
    if kept_reach(robot) is not None:
        yield
        return
    with open_pool(_PROCESSES) as pool:
        parts = [pool.submit(errors_at, robot, part, _PROCESSES) for part in range(_PROCESSES)]
        yield
        with contextlib.suppress(BrokenExecutor):  # one was killed: then it is worked out here
            keep_reach(robot, joined(robot, [part.result() for part in parts]))


def _pictures(name: str) -> tuple[tuple[Look, ...], str]:
    try:
        return looks(build_scene(name, _PLAIN), name), ""
    except RenderError as error:
        return (), str(error)


def _begin(name: str, task: str) -> TaskCheck:
    checked = TaskCheck(task, dict(widths(get_task(task))))
    try:
        build_scene(name, task)
    except UsageError as error:
        return dataclasses.replace(checked, refused=str(error))
    return checked


def _with_starts(name: str, task: TaskCheck) -> TaskCheck:
    if task.refused:
        return task
    return dataclasses.replace(
        task, starts=start_facts(build_scene(name, task.name), stream_seeds("validation", STARTS))
    )


def _with_episodes(
    name: str, task: TaskCheck, episodes: int, noise: Condition, engine: Engine, on_result: OnResult
) -> TaskCheck:
    if not episodes or not task.has_starts:
        return task
    seeds, found = stream_seeds("validation", episodes), list[ExpertFacts]()
    for condition in (NOMINAL, noise):
        found.append(expert_facts(engine, name, task.name, seeds, condition, on_result))
    return dataclasses.replace(task, clean=found[0], noisy=found[1])


def _task_json(task: TaskCheck) -> dict[str, Any]:
    def episodes(facts: ExpertFacts | None) -> dict[str, Any] | None:
        if facts is None:
            return None
        success = facts.success
        return {
            "successes": success.successes,
            "n": success.n,
            "interval": success.interval,
            "failures": facts.failures,
        }

    starts = task.starts and {"found": task.starts.found, "drawn": task.starts.drawn, "why": task.starts.why}
    return {
        "task": task.name,
        "done": task.done,
        "widths": task.widths,
        "refused": task.refused,
        "starts": starts,
        "clean": episodes(task.clean),
        "noisy": episodes(task.noisy),
    }
