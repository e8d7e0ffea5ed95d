"""`manip-il robot new`: a first YAML for an arm of one's own; `manip-il robot check`: what that arm can do."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il import checks
from manip_il.cli.inputs import require_folder
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import open_output, require_new
from manip_il.cli.progress import progress, say, warn
from manip_il.errors import ManipError, RenderError, UnknownName, UsageError
from manip_il.option import option
from manip_il.tasks import NAMES

if TYPE_CHECKING:
    from manip_il.evaluation.robot_check import RobotCheck

SUFFIXES = (".yaml", ".yml")
PAGE = "check.html"


@dataclass
class RobotNewOptions:
    """Write a first YAML for an arm's MJCF: hand, fingers and workspace as they look on the model.

    Every line says what it means. What is found beyond that (joints, home, gains, the hand's frame) stands below as
    comments, to be said otherwise. Then checks the robot, as `robot check --episodes=0` does, and says what to change.
    Exits with 1 if it can do no task yet.
    """

    example: ClassVar[str] = "manip-il robot new my_arm.xml --output=my_arm.yaml"
    model: Path = option(MISSING, "the arm's MJCF", positional=True)
    gripper: Path | None = option(None, "the gripper's MJCF, where that is another file")
    output: Path | None = option(None, "the YAML; by default beside the model, with its name")
    overwrite: bool = option(False, "replace an existing file")

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        for path in filter(None, (self.model, self.gripper)):
            if not path.is_file():
                raise UsageError(f"{path} is not there; expected an MJCF")
        target = self._target()
        if target.suffix not in SUFFIXES:
            raise UsageError(f"--output is {target}; expected a file, NAME.yaml")
        checks.name(f"the name of {target}, which will be the robot's,", target.stem)
        require_folder(target.parent, f"the folder of {target}")
        if target.exists() and not self.overwrite:
            raise UsageError(f"{target} exists already; choose another --output, or give --overwrite")

    def run(self) -> None:
        """Write the YAML, check the robot, and say what is left to do. Raises `ManipError` if it can do nothing yet."""
        from manip_il.data.atomic import write_file
        from manip_il.evaluation.robot_page import advice, verdict
        from manip_il.robots.suggest import found_lines, suggest, yaml_of
        from manip_il.robots.table import get_robot

        target = self._target()
        paths = [os.path.relpath(path, target.parent) if path else "" for path in (self.model, self.gripper)]
        found = suggest(self.model, self.gripper)
        text = yaml_of(found, *paths)
        for doubt in found.doubts:
            say(f"look: {doubt}")
        write_file(target, text.encode())
        try:
            write_file(target, (text + found_lines(get_robot(str(target)))).encode())
            checked = _measure(str(target), list(NAMES), 0)
        except ManipError as error:
            raise ManipError(f"wrote {target}, which cannot be used yet: {error}") from None
        except BaseException:
            target.unlink(missing_ok=True)
            raise
        say(f"wrote {target}. {verdict(checked)}")
        for line in advice(checked):
            say(f"change: {line}")
        if len(checked.failed) == len(NAMES):
            raise ManipError(f"wrote {target}, with which no task can be done yet; see above")
        say(f"look at the robot: manip-il view --robot.type={target} --task.type=pick_place")

    def _target(self) -> Path:
        return self.output or self.model.with_suffix(".yaml")


def _measure(
    robot: str, tasks: Sequence[str], episodes: int, on_result: Callable[[object], object] = lambda _: None
) -> RobotCheck:
    from manip_il.collect.workers import Engine
    from manip_il.evaluation.robot_check import check_robot

    with Engine(None) as engine:
        return check_robot(robot, tasks, episodes, engine, on_result)


@dataclass
class RobotCheckOptions:
    """Measure what an arm can do, before anything is recorded; writes check.html and check.json.

    Joints and gripper as they move, pictures of the arm with its frame and cameras, where it reaches, and the expert at
    every task, as it is and with a tenth of the steps random; and what to change where something does not work. Exits
    with 1 where a task cannot be done.
    """

    example: ClassVar[str] = "manip-il robot check my_arm.yaml --tasks=reach,pick_place --output_dir=runs/my_arm"
    robot: str = option(MISSING, "its YAML, or the name of one that ships", positional=True)
    tasks: list[str] = option(list, f"of {', '.join(NAMES)}; by default all")
    episodes: int = option(50, "of the expert at each task, and as many with random actions; 0 for none")
    output_dir: Path = option(Path("runs/robot_check"), f"folder of {PAGE}")
    overwrite: bool = option(False, "replace an existing check")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong, and a robot that cannot be used."""
        from manip_il.seeding import stream_seeds

        if self.episodes < 0:
            raise UsageError(f"--episodes is {self.episodes}; expected 0 or more")
        stream_seeds("validation", self.episodes)
        if odd := next((task for task in self.tasks if task not in NAMES), None):
            raise UnknownName("task in --tasks:", odd, NAMES)
        require_new(self.output_dir, overwrite=self.overwrite)
        from manip_il.robots.gripper import sweep
        from manip_il.robots.table import get_robot

        sweep(get_robot(self.robot))

    def run(self) -> None:
        """Measure, print the tables, write the page. Raises `ManipError` where a task cannot be done."""
        from manip_il.evaluation.robot_check import FILE_NAME
        from manip_il.evaluation.robot_page import check_report, looks

        tasks = list(dict.fromkeys(self.tasks)) or list(NAMES)
        with open_output(self) as folder:
            with progress(2 * self.episodes * len(tasks), f"check {self.robot}") as bar:
                found = _measure(self.robot, tasks, self.episodes, lambda _: bar.advance())
            found.write(folder / FILE_NAME)
            try:
                pictures, no_pictures = looks(self.robot), ""
            except RenderError as error:
                pictures, no_pictures = (), str(error)
                warn(f"the page has no pictures: {error}")
            report = check_report(found, pictures, no_pictures, command_line("robot check", self), to_plain(self))
            report.write(folder / PAGE)
        self._say(found)
        say(f"page: {folder / PAGE}")
        if found.failed:
            names = ", ".join(task.name for task in found.failed)
            raise ManipError(f"{self.robot} cannot do {len(found.failed)} of {len(tasks)} tasks: {names}; see above")

    def _say(self, found: RobotCheck) -> None:
        from manip_il.evaluation.robot_page import advice, home_line, joint_table, motors_line, task_table, verdict
        from manip_il.evaluation.tables import print_table

        print_table(joint_table(found))
        say(motors_line(found))
        say(f"The gripper opens to {1000 * found.opening:.1f} mm. {home_line(found)}")
        print_table(task_table(found))
        say(verdict(found))
        for line in advice(found):
            say(f"change: {line}")
