"""A robot's check as a page: tables, pictures, reach, and what to change."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from manip_il.evaluation.figures import INK, Figure, drawing, plain, to_figure
from manip_il.evaluation.film import encode_jpeg
from manip_il.evaluation.report import Report, Section, Still
from manip_il.evaluation.robot_check import ENOUGH, LOW, SOLVES, RobotCheck, TaskCheck
from manip_il.evaluation.tables import CLONING, DAGGER, EXPERT, Table
from manip_il.robots.reach import reach_of
from manip_il.sim.config import FILM
from manip_il.sim.render import Line, Overview, marked_picture
from manip_il.sim.task import TakesShape
from manip_il.tasks.envs import scene_of
from manip_il.tasks.table import get_task

_ROOM = 0.13  # of a map around the workspace [m]
_SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))
_AXES = ((0.85, 0.12, 0.12, 1.0), (0.10, 0.62, 0.20, 1.0), (0.10, 0.30, 0.90, 1.0))  # x red, y green, z blue
_SPACE = (0.05, 0.45, 0.75, 1.0)


def check_report(
    check: RobotCheck, pictures: Sequence[Still], no_pictures: str, command: str, config: Mapping[str, Any]
) -> Report:
    """Return the page of a check. no_pictures: why there are none."""
    lead = () if pictures else (f"No pictures: {no_pictures}",)
    tasks = (
        "Starts: of those drawn, how many find a place within reach. Random actions: a tenth of the control steps, the "
        "gripper's too. Intervals are Wilson's score intervals.",
    )
    home = (
        "Of ee, x is red, y (the fingers' way) green, z (out of the hand) blue; the workspace is blue.",
        home_line(check),
    )
    reaches = (
        f"The hand, pointing down, gets to {100 * check.table:.0f} % of the workspace (the frame) on the table: where "
        "it is green. Circles: objects at the start, squares: goals, and what stands there.",
    )
    return Report(
        title=f"{check.robot.name}: robot check",
        verdict=verdict(check),
        facts=advice(check),
        command=command,
        config=config,
        sections=(
            Section("Tasks", tables=(task_table(check),), notes=tasks),
            Section("At home in its scene", lead, stills=tuple(pictures), notes=home),
            Section("Where it reaches, and where tasks begin", figures=start_figures(check), notes=reaches),
        ),
    )


def verdict(check: RobotCheck) -> str:
    """Return in a sentence which tasks a robot can do."""
    name, failed, count = check.robot.name, check.failed, len(check.tasks)
    asked = any(task.clean is not None for task in check.tasks)
    can, end = ("can do", "") if asked else ("has starts for", "; the expert was not asked")
    words = f"{name} {can} {f'all {count} tasks' if count > 1 else check.tasks[0].name}{end}"
    if failed:
        cannot = ", ".join(task.name for task in failed)
        words = (
            f"{name} {can} {count - len(failed)} of {count} task{'s' if count > 1 else ''}{end}; it cannot do {cannot}"
        )
    shaken = [(task.name, task.noisy.success) for task in check.tasks if task.done and task.noisy is not None]
    if poor := [f"{one} in {success.successes} of {success.n}" for one, success in shaken if success.rate < SOLVES]:
        words += f"; with a tenth of the steps random the expert solves {', '.join(poor)} episodes"
    return f"{words}."


def task_table(check: RobotCheck) -> Table:
    """Return the tasks: object against opening, starts, and the expert's success, clean and with random actions."""
    columns = ("task", "object [mm]", "starts", "expert [95 % interval]", "with random actions")
    rows: list[tuple[str, ...]] = []
    for task in check.tasks:
        wide = max(task.widths.values(), default=0.0)
        fits = f"{1000 * wide:.0f}, {'fits' if wide < check.opening else 'too wide'}" if wide else "none grasped"
        starts = f"{task.found} of {task.drawn}" if task.drawn else ""
        rows.append((task.name, fits, starts, *(str(one.success) if one else "" for one in (task.clean, task.noisy))))
    return Table(columns, tuple(rows), tuple(EXPERT if task.done else CLONING for task in check.tasks))


def home_line(check: RobotCheck) -> str:
    """Return in sentences how wide the gripper opens, and whether the robot is free at home."""
    opens = f"The gripper opens to {1000 * check.opening:.1f} mm."
    if not check.overlaps:
        return f"{opens} At home no part of the robot touches another or the table."
    pairs = ", ".join(f"{one} and {other}" for one, other in check.overlaps)
    return f"{opens} At home these overlap, as in every posture: {pairs}."


def start_figures(check: RobotCheck) -> tuple[Figure, ...]:
    """Draw where the hand, pointing down, gets to on the table, with the starts of each task."""
    reach, (x, y), half = reach_of(check.robot), check.robot.workspace.centre, check.robot.workspace.half_width
    offsets = (np.linspace(-1, 1, 121)[1::2] * (half + _ROOM)).tolist()
    reached = [[float(reach.has((x + dx, y + dy, LOW))) for dx in offsets] for dy in offsets]
    extent = (x - half - _ROOM, x + half + _ROOM, y - half - _ROOM, y + half + _ROOM)
    figures: list[Figure] = []
    for task in check.tasks:
        with drawing(1, size=(2.8, 2.8)) as (drawn, axes):
            axis, words = axes[0, 0], f"{task.found} of {task.drawn} starts" if task.drawn else "no scene"
            axis.imshow(reached, extent=extent, origin="lower", cmap="Greens", vmin=0, vmax=3, interpolation="nearest")
            axis.plot(*np.array([(x + a * half, y + b * half) for a, b in _SQUARE]).T, color=INK, lw=1)
            axis.plot(*np.reshape(task.goals, (-1, 2)).T, "s", ms=3.5, mfc="none", mec=CLONING)
            axis.plot(*np.reshape(task.objects, (-1, 2)).T, "o", ms=3.5, color=DAGGER)
            axis.set(xlim=extent[:2], ylim=extent[2:], xlabel="x [m]", ylabel="y [m]")
            axis.grid(visible=False)
            axis.set_title(f"{plain(task.name)}: {words}", loc="left")
            figures.append(to_figure(drawn, f"Starts of {task.name} from above: {words}"))
    return tuple(figures)


def advice(check: RobotCheck) -> tuple[str, ...]:
    """Return what to change in the robot's YAML, the arm's first, then for each task that cannot be done."""
    lines = [
        f"{one} and {other} overlap however the arm stands: take one of their contacts out of the model."
        for one, other in check.overlaps
    ]
    space = check.robot.workspace
    if check.table < ENOUGH:
        change = f"take half_width: {check.half_width:g} in place of {space.half_width:g}"
        if not check.half_width:
            change = f"move workspace.centre, ({space.centre[0]:g}, {space.centre[1]:g}), to where the map is green"
        if not check.table and check.robot.gripper.files is not None:
            change += "; or turn the gripper on the hand by gripper.quaternion"
        lines.append(f"The hand gets to {100 * check.table:.0f} % of the workspace on the table: {change}.")
    return (*lines, *(line for task in check.failed for line in _task_advice(check, task)))


def _task_advice(check: RobotCheck, task: TaskCheck) -> Iterator[str]:
    wide, most = max(task.widths.values(), default=0.0), check.opening
    if wide >= most:
        change = "widen gripper.open, or leave the task out"
        if isinstance(get_task(task.name), TakesShape):
            narrow = max(0.005, math.floor(0.6 * most / 0.005) * 0.005)
            change = f"choose a narrower one, --task.object=box:{narrow:.3g}, or widen gripper.open"
        yield f"{task.name}: its object is {1000 * wide:.0f} mm wide, the gripper opens {1000 * most:.0f} mm: {change}."
    elif task.drawn and not check.table:
        return  # said of the whole workspace
    elif task.refused:
        yield f"{task.name}: {task.refused}."
    elif task.clean is not None:
        success, (phase, count) = task.clean.success, next(iter(task.clean.failures.items()))
        failed = f"the expert fails in {success.n - success.successes} of {success.n} episodes"
        watch = f"manip-il view --robot.type={check.name} --task.type={task.name}"
        yield f"{task.name}: {failed}, {count} in phase {phase}; watch it: {watch}"


def looks(name: str) -> tuple[Still, ...]:
    """Return pictures of a robot at home, with its frame `ee` and its workspace drawn into them.

    Raises `RenderError` without off-screen OpenGL.
    """
    scene = scene_of(name, "reach")
    data, gripper = mujoco.MjData(scene.model), scene.gripper
    data.qpos[scene.arm_q] = data.ctrl[scene.arm_ctrl] = scene.robot.home
    data.qpos[gripper.q] = data.ctrl[gripper.ctrl] = gripper.command(gripper.most)
    mujoco.mj_forward(scene.model, data)
    ee, rotation = data.site_xpos[scene.ee_site].copy(), data.site_xmat[scene.ee_site].reshape(3, 3)
    lines = [Line(ee, ee + 0.06 * axis, colour, 0.0035) for axis, colour in zip(rotation.T, _AXES, strict=True)]
    (x, y), half = scene.robot.workspace.centre, scene.robot.workspace.half_width
    corners = [np.array([x + a * half, y + b * half, 0.001]) for a, b in _SQUARE]
    lines += [Line(a, b, _SPACE, 0.003) for a, b in itertools.pairwise(corners)]
    points = np.vstack([data.xpos[1:], corners])
    points = points[np.abs(points).max(axis=1) < 3]  # without what was put out of sight
    low, high = points.min(axis=0), points.max(axis=0)
    distance = 0.6 * float(np.linalg.norm(high - low)) / math.sin(math.radians(22.5))
    views: tuple[tuple[str | Overview, str], ...] = (
        (Overview((low + high) / 2, distance, 55.0, -20.0), "from outside"),
        ("front", "what camera front sees"),
        ("wrist", "what camera wrist sees"),
    )
    data.mocap_pos[:, 2] = -9.0  # goals: out of sight
    return tuple(
        Still(words, encode_jpeg(marked_picture(scene, data, view, (480, 640), FILM, lines))) for view, words in views
    )
