"""`manip-il robot new`, `check`, `certify`: a YAML file for your own arm, and what the arm and its expert can do."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import ClassVar

from manip_il.cli.common_options import EngineOptions
from manip_il.cli.options import Given, given
from manip_il.cli.outputs import Output, Replacing, output_folder
from manip_il.option import NameOrPath, Seeded, option
from manip_il.tasks import NAMES
from manip_il.worlds.config import EnvConfig


@dataclass(frozen=True)
class RobotNewOptions(Replacing):
    """Write a first YAML file for an arm's MJCF, with hand, fingers and workspace as suggested by the model.

    Comments in the file explain its values. Joints, home, gains and the hand's frame are not in it: they are taken from
    the model unless you add them. Then checks the robot, like `robot check --episodes=0`, and prints what to change.
    The exit code is 1 if the robot cannot do any task yet.

    Example: manip-il robot new my_arm.xml --output=my_arm.yaml
    """

    model: Path = option(MISSING, "the arm's MJCF", positional=True, exists="")
    gripper: Path | None = option(None, "the gripper's MJCF, if it is a separate file", exists="")
    output: Path | None = option(None, "the YAML file; by default next to the model, with its name")


@dataclass(frozen=True)
class RobotCheckOptions(Output):
    """Measure what an arm can do, before recording; writes check.html and check.json.

    Shows the arm with its hand frame and cameras, its reach, the expert's success at every task (also with a tenth of
    its actions random), and what to change if something does not work. The exit code is 1 if a task cannot be done.

    Example: manip-il robot check my_arm.yaml --tasks=reach,pick_place --output_dir=runs/my_arm
    """

    robot: NameOrPath = option(MISSING, "the robot's YAML file, or the name of a built-in robot", positional=True)
    tasks: list[str] = option(list, f"any of {', '.join(NAMES)}; by default all")
    episodes: int = option(
        50,
        "expert episodes per task, and as many with a tenth of the actions random; 0 for none",
        at_least=0,
        at_most=1_000_000,
    )
    output_dir: Path = output_folder("runs/robot_check")


@dataclass(frozen=True)
class CertifyOptions(Seeded, EngineOptions, Output):
    """Measure how the expert recovers from perturbed states and wrong actions; writes certificate.json.

    Example: manip-il robot certify --task.type=stack --output_dir=runs/certificate
    """

    first: ClassVar[str] = "robot.type task.type cases output_dir"
    env: Given = given(EnvConfig)
    cases: int = option(500, "episodes for each kind of perturbation", at_least=1, at_most=1_000_000)
    output_dir: Path = output_folder("runs/certificate")
