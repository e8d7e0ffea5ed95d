"""The check as tables for the terminal, and as `check.html`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from manip_il.evaluation.maps import MAP_HEIGHT, MARGIN, WIDTH, View, fit_view
from manip_il.evaluation.report import Report
from manip_il.evaluation.robot_check.advice import advice
from manip_il.evaluation.robot_check.check import SOLVES, RobotCheck, TaskCheck
from manip_il.evaluation.robot_check.joints import LOAD, JointFacts
from manip_il.evaluation.tables import Table

_GOOD, _BAD = "expert", "cloning"  # colours of rows
_ROOM = 0.13  # of a map around the workspace [m]


def check_report(check: RobotCheck, command: str, config: Mapping[str, Any]) -> CheckReport:
    """Return the page of a check."""
    return CheckReport(
        title=f"{check.robot.name}: robot check",
        verdict=verdict(check),
        facts=advice(check),
        command=command,
        config=config,
        check=check,
    )


def verdict(check: RobotCheck) -> str:
    """Return in a sentence which tasks a robot can do."""
    name, failed, count = check.robot.name, check.failed, len(check.tasks)
    asked = any(task.clean is not None for task in check.tasks)
    if not failed:
        which = f"all {count} tasks" if count > 1 else check.tasks[0].name
        return (
            f"{name} can do {which}{_noisy(check)}."
            if asked
            else f"{name} has starts for {which}; the expert was not asked."
        )
    names, rest = _listed([task.name for task in failed]), count - len(failed)
    if not asked:
        others = f"; it has starts for the other {f'{rest} tasks' if rest > 1 else 'one'}, the expert was not asked"
        return f"{name} cannot do {names}{others if rest else ''}."
    return f"{name} can do {rest} of {count} task{'s' if count > 1 else ''}{_noisy(check)}; it cannot do {names}."


def _noisy(check: RobotCheck) -> str:
    """Return which of the tasks that can be done the expert does not solve under random actions, and how often."""
    done = [(task.name, task.noisy.success) for task in check.tasks if task.done and task.noisy is not None]
    poor = [f"{name} in {one.successes} of {one.n} episodes" for name, one in done if one.rate < SOLVES]
    return f", but with a tenth of the steps random the expert solves {_listed(poor)}" if poor else ""


def joint_table(check: RobotCheck) -> Table:
    """Return the joints base to hand: limits, home, gains, and how they move and hold."""
    columns = ("joint", "limits", "home", "kp", "kv", "force", "rise [ms]", "overshoot", "sag")
    return Table(columns, tuple(_joint_row(joint) for joint in check.arm.joints))


def hand_table(check: RobotCheck) -> Table:
    """Return the gripper's opening at each command."""
    hand = check.hand
    command = f"command of {hand.joints[0]}"
    rows = zip(hand.commands, hand.openings, strict=True)
    return Table(
        (command, "opening [mm]"), tuple((f"{round(at, 4) + 0.0:g}", f"{1000 * opening:.1f}") for at, opening in rows)
    )


def task_table(check: RobotCheck) -> Table:
    """Return the tasks: object against opening, starts, and the expert's success, clean and with random actions."""
    columns = ("task", "object [mm]", "starts", "expert [95 % interval]", "with random actions")
    kinds = tuple(_GOOD if task.done else _BAD for task in check.tasks)
    return Table(columns, tuple(_task_row(check, task) for task in check.tasks), kinds)


def home_line(check: RobotCheck) -> str:
    """Return in a sentence whether the robot is free at home."""
    if not check.overlaps:
        return "At home no part of the robot touches another or the table."
    pairs = ", ".join(f"{one} and {other}" for one, other in check.overlaps)
    return f"At home these overlap, as in every posture: {pairs}."


def motors_line(check: RobotCheck) -> str:
    """Return in a sentence what drives the joints."""
    count = len(check.arm.own_motors)
    motors = "The model has no motors and gets position control"
    if count:
        motors = f"The model's own {count} motor{'s are' if count > 1 else ' is'} replaced by position control"
    return (
        f"{motors}: torque = kp (target - joint) - kv velocity, at most the force; gravity is compensated. kp is in "
        "N m/rad, kv in N m s/rad, force in N m. "
        f"Rise and overshoot: of a step of {check.arm.step:g} rad from home, the longest that a label takes. "
        f"Sag: off home with {LOAD:g} kg in the hand, which sinks by {1000 * check.arm.sag:.1f} mm."
    )


@dataclass(frozen=True)
class StartMap:
    """Starts of a task from above. words: how many there are; objects, goals: where, x and y [px]."""

    name: str
    done: bool
    words: str
    objects: Sequence[Sequence[float]]
    goals: Sequence[Sequence[float]]


@dataclass(frozen=True, kw_only=True)
class CheckReport(Report):
    """The page of a check, made by `check_report`."""

    template: ClassVar[str] = "robot.html.j2"
    check: RobotCheck

    @property
    def tables(self) -> Mapping[str, Table]:
        """Tables by the part of the page that they are in."""
        return {"tasks": task_table(self.check), "joints": joint_table(self.check), "hand": hand_table(self.check)}

    @property
    def notes(self) -> Mapping[str, str]:
        """Sentences by the part of the page that they are in."""
        check, reach = self.check, self.check.reach
        return {
            "tasks": "Starts: of those drawn, how many find a place within reach. Random actions: a tenth of the "
            "control steps, the gripper's too. Intervals are Wilson's score intervals.",
            "joints": motors_line(check),
            "home": home_line(check),
            "chain": f"Bodies from the base: {', '.join(check.arm.bodies)}. The hand is {check.robot.hand}; "
            f"ee, between the fingertips, is a frame of {check.robot.ee.body}.",
            "reach": f"The hand, pointing down, gets to {100 * reach.table:.0f} % of the workspace on the table, "
            f"leaning to {100 * reach.leaning:.0f} %, and to {100 * reach.air:.0f} % of the room above it. "
            "Starts are drawn from there.",
        }

    @cached_property
    def view(self) -> View:
        """The workspace from above, as every map has it."""
        space = self.check.robot.workspace
        (x, y), half = space.centre, space.half_width + _ROOM
        return fit_view(np.array([[x - half, y - half, 0.0], [x + half, y + half, 0.0]]), 0, 1, MAP_HEIGHT)

    @cached_property
    def cells(self) -> list[tuple[float, float, float, float, bool]]:
        """Cells of the table that the hand reaches: left, top, width, height [px], and whether upright."""
        found = []
        for run in self.check.reach.rows:
            (left, low), (right, top) = self._project([(run.x, run.y), (run.x + run.dx, run.y + run.dy)])
            found.append((left, top, right - left, low - top, run.upright))
        return found

    @cached_property
    def space(self) -> tuple[float, float, float, float]:
        """The workspace: left, top, width, height [px]."""
        space = self.check.robot.workspace
        (x, y), half = space.centre, space.half_width
        (left, low), (right, top) = self._project([(x - half, y - half), (x + half, y + half)])
        return left, top, right - left, low - top

    @cached_property
    def maps(self) -> list[StartMap]:
        """The tasks' starts."""
        return [self._map(task) for task in self.check.tasks]

    @property
    def widths(self) -> dict[float, str]:
        """Width of what is grasped [m] -> names of its tasks."""
        names: dict[float, list[str]] = {}
        for task in self.check.tasks:
            for width in {round(width, 4) for width in task.widths.values()}:
                names.setdefault(width, []).append(task.name)
        return {width: ", ".join(found) for width, found in sorted(names.items())}

    @cached_property
    def curve_of_hand(self) -> list[tuple[float, float]]:
        """Opening over command as points from 0 to 1, (c,)."""
        hand = self.check.hand
        first, last = hand.closed[0], hand.open[0]
        return [
            ((at - first) / (last - first), opening / hand.most)
            for at, opening in zip(hand.commands, hand.openings, strict=True)
        ]

    def _map(self, task: TaskCheck) -> StartMap:
        starts = task.starts
        if starts is None:
            return StartMap(task.name, False, "no scene", [], [])
        words = f"{starts.found} of {starts.drawn} starts"
        return StartMap(task.name, task.has_starts, words, self._project(starts.objects), self._project(starts.goals))

    def _project(self, places: Sequence[tuple[float, float]]) -> list[list[float]]:
        if not places:
            return []
        points = self.view.project(np.array([(*at, 0.0) for at in places])).tolist()
        return [at for at in points if 0 <= at[0] <= WIDTH and 0 <= at[1] <= MAP_HEIGHT - MARGIN / 4]


def _joint_row(joint: JointFacts) -> tuple[str, ...]:
    def angle(value: float) -> str:
        return f"{1000 * value:.1f} mm" if joint.slides else f"{math.degrees(value):.0f}°"

    limits = "free" if joint.limits is None else f"{angle(joint.limits[0])} to {angle(joint.limits[1])}"
    sag = f"{1000 * joint.sag:.1f} mm" if joint.slides else f"{math.degrees(joint.sag):.2f}°"
    rise = "over 1,000" if joint.rise is None else f"{1000 * joint.rise:.0f}"
    numbers = (f"{joint.kp:.4g}", f"{joint.kv:.3g}", f"{joint.force:.3g}")
    return (joint.name, limits, angle(joint.home), *numbers, rise, f"{100 * joint.overshoot:.0f} %", sag)


def _task_row(check: RobotCheck, task: TaskCheck) -> tuple[str, ...]:
    wide = max(task.widths.values(), default=0.0)
    fits = f"{1000 * wide:.0f}, {'fits' if wide < check.hand.most else 'too wide'}" if wide else "none grasped"
    starts = "" if task.starts is None else f"{task.starts.found} of {task.starts.drawn}"
    success = (
        "" if facts is None else f"{facts.success.successes} of {facts.success.n} {_interval(facts.success.interval)}"
        for facts in (task.clean, task.noisy)
    )
    return (task.name, fits, starts, *success)


def _interval(ends: tuple[float, float]) -> str:
    return f"[{100 * ends[0]:.0f}, {100 * ends[1]:.0f}]"


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
