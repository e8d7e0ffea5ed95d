"""`manip-il robot new`: a first YAML for an arm of one's own."""

from __future__ import annotations

import os
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import ClassVar

from manip_il.cli.inputs import require_folder
from manip_il.cli.progress import say, warn
from manip_il.errors import ManipError, UsageError
from manip_il.option import option

SUFFIXES = (".yaml", ".yml")


@dataclass
class RobotNewOptions:
    """Write a first YAML for an arm's MJCF: hand, fingers and workspace as they look on the model.

    Every line says what it means. What is found beyond that (joints, home, gains, the hand's frame) stands below as
    comments, to be said otherwise.
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
        require_folder(target.parent, f"the folder of {target}")
        if target.exists() and not self.overwrite:
            raise UsageError(f"{target} exists already; choose another --output, or give --overwrite")

    def run(self) -> None:
        """Write the YAML, and say what to do with it."""
        from manip_il.robots.robot import Robot
        from manip_il.robots.suggest import found_lines, suggest, yaml_of

        target = self._target()
        paths = [os.path.relpath(path, target.parent) if path else "" for path in (self.model, self.gripper)]
        text = yaml_of(suggest(self.model, self.gripper), *paths)
        target.write_text(text, encoding="utf-8")
        try:
            target.write_text(text + found_lines(Robot.read(target)), encoding="utf-8")
        except ManipError as error:
            warn(str(error))
            say(f"wrote {target}; mend that, then look at the robot: manip-il view --robot.type={target}")
            return
        say(f"wrote {target}; look at the robot: manip-il view --robot.type={target} --task.type=pick_place")

    def _target(self) -> Path:
        return self.output or self.model.with_suffix(".yaml")
