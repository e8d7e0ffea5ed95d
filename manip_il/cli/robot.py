"""`manip-il robot new`, `check`, `certify`: a YAML file for your own arm, and what the arm and its expert can do."""

from __future__ import annotations

import os
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import ClassVar

from manip_il import checks
from manip_il.cli.common_options import EngineOptions, env_config
from manip_il.cli.options import Given, command_line, given, group, to_plain
from manip_il.cli.outputs import Output, OutputFile, Replacing, publish
from manip_il.cli.progress import progress, say, say_next
from manip_il.data.atomic import write_file, write_json
from manip_il.errors import ManipError, RenderError
from manip_il.option import NameOrPath, Seeded, option
from manip_il.tasks import NAMES
from manip_il.tasks.config import EnvConfig

PAGE = "check.html"


@dataclass(frozen=True)
class RobotNewOptions(Replacing):
    """Write a first YAML file for an arm's MJCF, with hand, fingers and workspace as suggested by the model.

    Comments in the file explain its values. Joints, home, gains and the hand's frame are not in it: they are taken from
    the model unless you add them. Then checks the robot, like `robot check --episodes=0`, and prints what to change.
    The exit code is 1 if the robot cannot do any task yet.
    """

    example: ClassVar[str] = "manip-il robot new my_arm.xml --output=my_arm.yaml"
    model: Path = option(MISSING, "the arm's MJCF", positional=True, exists="")
    gripper: Path | None = option(None, "the gripper's MJCF, if it is a separate file", exists="")
    output: Path | None = option(None, "the YAML file; by default next to the model, with its name")

    def run(self) -> None:
        """Write the YAML file, check the robot, print what is left to do. Raises `ManipError` if it can do no task."""
        from manip_il.collect.workers import Engine
        from manip_il.evaluation.robot_check import advice, check_robot, verdict
        from manip_il.robots.suggest import suggest, yaml_of

        target = self.output or self.model.with_suffix(".yaml")
        checks.name(f"the name of {target}, which becomes the robot's,", target.stem)
        OutputFile(target, overwrite=self.overwrite).check()
        paths = [os.path.relpath(path, target.parent) if path else "" for path in (self.model, self.gripper)]
        found = suggest(self.model, self.gripper)
        write_file(target, yaml_of(found, *paths).encode())
        say(f"robot: {target}")
        with Engine(None) as engine:
            checked = check_robot(target, list(NAMES), 0, engine, lambda _: None)
        say(verdict(checked), *(f"change: {line}" for line in advice(checked)))
        if len(checked.failed) == len(NAMES):
            raise ManipError(f"{target} cannot do any task yet; see above")
        say_next("view", f"--robot.type={target}", "--task.type=pick_place", what="look at the robot")


@dataclass(frozen=True)
class RobotCheckOptions:
    """Measure what an arm can do, before recording; writes check.html and check.json.

    Shows the arm with its hand frame and cameras, its reach, the expert's success at every task (also with a tenth of
    its actions random), and what to change if something does not work. The exit code is 1 if a task cannot be done.
    """

    example: ClassVar[str] = "manip-il robot check my_arm.yaml --tasks=reach,pick_place --output_dir=runs/my_arm"
    robot: NameOrPath = option(MISSING, "the robot's YAML file, or the name of a built-in robot", positional=True)
    tasks: list[str] = option(list, f"any of {', '.join(NAMES)}; by default all")
    episodes: int = option(
        50,
        "expert episodes per task, and as many with a tenth of the actions random; 0 for none",
        at_least=0,
        at_most=1_000_000,
    )
    output: Output = group(Output(Path("runs/robot_check")), prefix="")

    def run(self) -> None:
        """Measure, print the tables, write the report. Raises `ManipError` if a task cannot be done."""
        from manip_il.collect.workers import Engine
        from manip_il.evaluation import robot_check
        from manip_il.evaluation.tables import print_table
        from manip_il.robots.gripper import sweep
        from manip_il.robots.table import get_robot
        from manip_il.tasks.table import get_task

        sweep(get_robot(self.robot))  # raises, before anything is written, if the robot cannot be used
        tasks = self.tasks or list(NAMES)
        for task in tasks:
            get_task(task)
        with self.output.open(self) as folder:
            with progress(2 * self.episodes * len(tasks), f"check {self.robot}") as bar, Engine(None) as engine:
                found = robot_check.check_robot(self.robot, tasks, self.episodes, engine, lambda _: bar.step())
            write_json(folder / robot_check.FILE_NAME, found.to_json())
            try:
                pictures, no_pictures = [robot_check.looks(self.robot)], ""
            except RenderError as error:
                pictures, no_pictures = [], str(error)
            page = robot_check.check_report(found, pictures, no_pictures, command_line(), to_plain(self))
            page.write(folder / PAGE)
        print_table(robot_check.task_table(found))
        say(robot_check.verdict(found), *(f"change: {line}" for line in robot_check.advice(found)))
        say(f"page: {folder / PAGE}")
        if found.failed:
            names = ", ".join(task.name for task in found.failed)
            raise ManipError(f"{self.robot} cannot do {len(found.failed)} of {len(tasks)} tasks: {names}; see above")


@dataclass(frozen=True)
class CertifyOptions(Seeded):
    """Measure how the expert recovers from perturbed states and wrong actions; writes certificate.json."""

    example: ClassVar[str] = "manip-il robot certify --task.type=stack --output_dir=runs/certificate"
    first: ClassVar[str] = "robot.type task.type cases output_dir"
    env: Given = given(EnvConfig)
    cases: int = option(500, "episodes for each kind of perturbation", at_least=1, at_most=1_000_000)
    engine: EngineOptions = group(EngineOptions(), prefix="")
    output: Output = group(Output(Path("runs/certificate")), prefix="")

    def run(self) -> None:
        """Run the episodes, write `certificate.json`, print the tables."""
        from manip_il.evaluation.certify import FILE_NAME, certify, count_episodes

        env = env_config(self.env)
        with self.output.open(self) as folder:
            count = count_episodes(env, self.cases)
            with progress(count, f"certify {env.robot} {env.task}") as bar, self.engine.open() as engine:
                certificate = certify(engine, env, self.cases, self.seed, lambda _: bar.step())
            mu = certificate.mu
            lines = () if mu is None else (f"u of Ross et al. (2011) is at least {mu} steps",)
            publish(folder / FILE_NAME, certificate.to_json(), [certificate.table()], *lines)
