"""`manip-il serve`: a virtual SO-101 behind serial ports, for LeRobot's own programs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from manip_il.cli.common_options import Trusting, Varied
from manip_il.cli.options import Given, given
from manip_il.option import option
from manip_il.serve.config import ServoConfig, SessionConfig
from manip_il.worlds.config import EnvConfig


@dataclass(frozen=True)
class ServeOptions(Varied, Trusting):
    """Run a simulated SO-101 behind serial ports, which LeRobot's own programs open like those of a real arm.

    Prints both ports, the cameras, and a command line to copy. With `-- COMMAND ...` it runs that program on the ports
    and presses its keys as a person would: an episode ends when the task is solved, and a failed one is recorded
    again. --vary=servo also varies the servos. A policy as the leader (--leader=runs/lift) sets the default task and
    cameras.

    Example: manip-il serve --task.type=lift --cameras=front,wrist
    """

    first: ClassVar[str] = "task.type cameras leader servo log output_dir"
    command: list[str] = option(list, "a LeRobot program and its options, after `--`", positional=True)
    env: Given = given(EnvConfig, robot="so101")
    session: Given = given(SessionConfig, prefix="")
    servos: ServoConfig = field(default_factory=ServoConfig)
