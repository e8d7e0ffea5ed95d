"""Checks of a custom arm before anything is recorded: gripper, reach, start states, and the
expert on every task.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.collect.workers import Engine
from manip_il.errors import RenderError, UsageError
from manip_il.evaluation.measuring import evaluate
from manip_il.evaluation.report import (
    INTERVAL,
    Figure,
    Report,
    Section,
    Table,
    drawing,
    to_figure,
)
from manip_il.evaluation.results import EvalResult
from manip_il.option import NameOrPath
from manip_il.progress import Progress
from manip_il.robots.reach import reach_of
from manip_il.robots.robot import Robot
from manip_il.robots.table import get_robot
from manip_il.seeding import rng_for, stream_seeds
from manip_il.sim.config import CAMERAS, FILM, CameraConfig
from manip_il.sim.render import pictures
from manip_il.sim.scene import PREFIX
from manip_il.sim.world import Scene, World
from manip_il.worlds.ladder.world import scene_of
from manip_il.worlds.table import make_config

FILE_NAME = "check.json"
SOLVES = 0.9  # share of clean episodes that the expert must solve if a task is to count as possible
STARTS = 50  # number of starts drawn per task
ENOUGH = 0.95  # share of the workspace that a suitable robot reaches
_GRID = 41  # points along an axis of a map of the table
LOW = 0.03  # height of objects on the table [m]
_VIEW = (4.4, 3.5)  # size of a picture of the arm [inches]


@dataclass(frozen=True)
class TaskCheck:
    """The result of one task with a robot.

    Attributes:
        name: Name of the task.
        starts: Number of starts drawn before the first failure.
        refused: Why that start failed, or why there is no scene; empty if every start succeeded.
        clean: Evaluation of the expert; None if not run.
        noisy: Evaluation of the expert with a tenth of its actions random; None if not run.
    """

    name: str
    starts: int = 0
    refused: str = ""
    clean: EvalResult | None = None
    noisy: EvalResult | None = None

    @property
    def done(self) -> bool:
        """Whether the robot can do the task."""
        return not self.refused and (self.clean is None or self.clean.success.rate >= SOLVES)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "task": self.name,
            "done": self.done,
            "starts": self.starts,
            "refused": self.refused,
            "clean": self.clean and self.clean.success.to_json(),
            "noisy": self.noisy and self.noisy.success.to_json(),
        }


@dataclass(frozen=True)
class RobotCheck:
    """Measurements of a robot.

    Attributes:
        name: The robot as given by the user.
        robot: The robot's description.
        opening: Largest opening of the gripper [m].
        table: Share of the workspace on the table that the hand reaches while it points down.
        tasks: The results of the tasks.
    """

    name: NameOrPath
    robot: Robot
    opening: float
    table: float
    tasks: tuple[TaskCheck, ...]

    @property
    def failed(self) -> tuple[TaskCheck, ...]:
        """Tasks that the robot cannot do."""
        return tuple(task for task in self.tasks if not task.done)

    def to_json(self) -> dict[str, Any]:
        """Return the contents of `check.json`."""
        return {
            "robot": str(self.name),
            "hand": self.robot.hand,
            "gripper": {"joints": self.robot.gripper.joints, "opening": self.opening},
            "reach": {"table": self.table},
            "tasks": [task.to_json() for task in self.tasks],
        }


def check_robot(
    name: NameOrPath,
    tasks: Sequence[str],
    episodes: int,
    engine: Engine,
    progress: Progress,
) -> RobotCheck:
    """Measure a robot on tasks.

    Args:
        name: The robot's name, or its YAML.
        tasks: Names of tasks.
        episodes: Episodes per task without random actions, and as many with.
        engine: What runs them.
        progress: Follows the episodes.

    Raises:
        UsageError: If the robot itself cannot be used.
    """
    robot, scene = get_robot(name), scene_of(name, "reach")
    checked = [check_starts(name, task) for task in tasks]
    for place, task in enumerate(checked):
        if episodes and not task.refused:
            clean, noisy = (
                evaluate(
                    env=make_config(name, task.name),
                    episodes=episodes,
                    suite=suite,
                    stream="validation",
                    workers=engine,
                    progress=progress,
                )
                for suite in ("nominal", "random_actions")
            )
            checked[place] = replace(task, clean=clean, noisy=noisy)
    table = float(_reached(robot, robot.workspace.half_width).mean())
    return RobotCheck(name, robot, scene.gripper.most, table, tuple(checked))


def check_starts(name: NameOrPath, task: str) -> TaskCheck:
    """Draw up to `STARTS` starts of a task with a robot, as episodes do.

    Stop at one without a valid placement.
    """
    starts = 0
    try:
        world = World(scene_of(name, task))
        world.update()
        for seed in stream_seeds("validation", STARTS):
            world.scene.task.draw(rng_for(seed, "reset"), world)
            starts += 1
    except UsageError as error:
        return TaskCheck(task, starts, str(error))
    return TaskCheck(task, starts)


def _reached(robot: Robot, half: float) -> NDArray[np.bool_]:
    """Return whether the hand, pointing down, reaches each point of a grid on the table: y along
    the rows, x along the columns, (n, n).
    """
    steps = np.linspace(-half, half, _GRID)
    x, y = robot.workspace.centre
    points = np.stack(np.meshgrid(x + steps, y + steps, [LOW]), axis=-1)
    return reach_of(robot).has_each(points.reshape(-1, 3)).reshape(_GRID, _GRID)


def check_report(check: RobotCheck) -> Report:
    """Return the HTML report of a check.

    Without off-screen OpenGL it says why it has no pictures.
    """
    try:
        pictures, lead = (looks(check.name),), ()
    except RenderError as error:
        pictures, lead = (), (f"No pictures: {error}",)
    tasks = (
        f"Starts: how many of {STARTS} were drawn before one found no place within reach. Random"
        " actions: a tenth of the actions, the gripper's included."
    )
    home = (
        "Axes of ee: x red, y (along the fingers' motion) green, z (out of the hand) blue. "
        f"The gripper opens to {1000 * check.opening:.1f} mm. Pointing down, the hand reaches"
        f" {100 * check.table:.0f} % of the workspace on the table."
    )
    return Report(
        title=f"{check.robot.name}: robot check",
        verdict=verdict(check),
        facts=advice(check),
        sections=(
            Section("Tasks", tables=(task_table(check),), notes=(tasks,)),
            Section("At home in its scene", lead, figures=pictures, notes=(home,)),
        ),
    )


def verdict(check: RobotCheck) -> str:
    """Return a sentence on which tasks a robot can do."""
    count, cannot = len(check.tasks), ", ".join(task.name for task in check.failed)
    can, end = ("has starts for", "; the expert was not run")
    if any(task.clean for task in check.tasks):
        can, end = ("can do", "")
    end += f"; it cannot do {cannot}." if cannot else "."
    return f"{check.robot.name} {can} {count - len(check.failed)} of {count} tasks{end}"


def task_table(check: RobotCheck) -> Table:
    """Return the table of tasks: starts, and the expert's success without and with random
    actions.
    """
    columns = ("task", "starts", f"expert {INTERVAL}", "with random actions")
    rows = tuple(
        (
            task.name,
            f"{task.starts} of {STARTS}",
            *(str(run.success) if run else "" for run in (task.clean, task.noisy)),
        )
        for task in check.tasks
    )
    return Table(columns, rows)


def advice(check: RobotCheck) -> tuple[str, ...]:
    """Return what to change in the robot's YAML: first for the arm, then for each task that it
    cannot do.
    """
    space = check.robot.workspace
    lines = _overlaps(scene_of(check.name, "reach"))
    if check.table < ENOUGH:
        x, y = space.centre
        wide = 2 * space.half_width
        steps = np.linspace(-wide, wide, _GRID)
        rows, columns = np.nonzero(_reached(check.robot, wide))  # along y, and along x
        middle = "elsewhere"
        if len(rows):
            middle = (
                f"{x + steps[columns].mean():.2f}, {y + steps[rows].mean():.2f}, the centre of the"
                " points near it that it reaches"
            )
        lines.append(
            f"The hand reaches {100 * check.table:.0f} % of the workspace on the table: reduce"
            f" workspace.half_width (now {space.half_width:g}), or move workspace.centre (now"
            f" {x:g}, {y:g}) to {middle}, or turn the gripper on the hand by gripper.quaternion."
        )
    for task in check.failed:
        if task.refused and check.table:  # if no point is within reach, the first line says so
            lines.append(f"{task.name}: {task.refused}.")
        elif task.clean is not None:
            success, phase = task.clean.success, next(iter(task.clean.failures))
            lines.append(
                f"{task.name}: the expert fails in {success.n - success.successes} of {success.n}"
                f" episodes, mostly in phase {phase}; watch it: manip-il view"
                f" --robot.type={check.name} --task.type={task.name}"
            )
    return tuple(lines)


def _overlaps(scene: Scene) -> list[str]:
    """Name the bodies that overlap at home, with their depth [mm], in a line.

    No line if there are none.
    """
    depths = dict[str, float]()
    for contact in _at_home(scene).contact:
        bodies = sorted(scene.model.geom_bodyid[contact.geom])
        pair = " and ".join(scene.model.body(body).name.removeprefix(PREFIX) for body in bodies)
        depths[pair] = max(depths.get(pair, 0.0), -1000 * contact.dist)
    pairs = ", ".join(f"{pair} by {depth:.1f} mm" for pair, depth in depths.items())
    remedy = (
        "set another home or base, or exclude their contacts in the model (<exclude body1="
        " body2=/>)."
    )
    return [f"At home parts overlap: {pairs}: {remedy}"] if pairs else []


def _at_home(scene: Scene) -> mujoco.MjData:
    """The physics of a scene with the arm at home and the gripper open."""
    data, gripper = mujoco.MjData(scene.model), scene.gripper
    data.qpos[scene.arm_q] = data.ctrl[scene.arm_ctrl] = scene.robot.home
    gripper.put(data, gripper.most)
    mujoco.mj_forward(scene.model, data)
    return data


def looks(name: NameOrPath) -> Figure:
    """Draw a robot in its home pose, with the axes of its frame `ee`, as its cameras see it.

    Raises `RenderError` without off-screen OpenGL.
    """
    scene = scene_of(name, "reach")
    data = _at_home(scene)
    data.mocap_pos[:, 2] = -9.0  # move goals out of sight
    with drawing(len(CAMERAS), size=_VIEW) as (drawn, axes):
        seen = pictures(scene, data, CameraConfig(CAMERAS, 480, 640, FILM), axes=True)
        for axis, (camera, picture) in zip(axes[0], seen.items(), strict=True):
            axis.imshow(picture)
            axis.set_title(f"camera {camera}")
            axis.axis("off")
        return to_figure(drawn, "The arm at home in its scene")
