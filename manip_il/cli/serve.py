"""`manip-il serve`: a virtual SO-101 behind serial ports, for LeRobot's own programs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from manip_il.cli.common_options import Varied, env_config
from manip_il.cli.options import Given, given
from manip_il.cli.progress import say, warn
from manip_il.option import option
from manip_il.serve.config import ServoConfig, SessionConfig
from manip_il.tasks.config import EnvConfig

SERVO = "servo"  # a value of --vary


@dataclass(frozen=True)
class ServeOptions(Varied):
    """Run a simulated SO-101 behind serial ports, which LeRobot's own programs open like those of a real arm.

    Prints both ports, the cameras, and a command line to copy. With `-- COMMAND ...` it runs that program on them and
    presses its keys as a person would: an episode ends when the task is solved, and a failed one is recorded again.
    --vary also takes servo.
    """

    example: ClassVar[str] = "manip-il serve --task.type=lift --cameras=front,wrist"
    first: ClassVar[str] = "task.type cameras servo log output_dir"
    command: list[str] = option(list, "a LeRobot program and its options, after `--`", positional=True)
    env: Given = given(EnvConfig, robot="so101")
    session: Given = given(SessionConfig, prefix="")
    servos: ServoConfig = field(default_factory=ServoConfig)

    def run(self) -> None:
        """Serve until the program ends or the user presses Ctrl-C."""
        from manip_il.data.atomic import exclusive
        from manip_il.evaluation.suites import varied
        from manip_il.serve.session import serve

        env = env_config(self.env)
        cameras = self.camera_config(env) if self.cameras else None
        conditions = varied([one for one in self.vary if one != SERVO], env, sees=cameras is not None)
        session = SessionConfig(**self.session, servos=self.servos, varies=SERVO in self.vary)
        with exclusive(session.output_dir):
            serve(env, session, self.command, cameras, conditions, say, warn)
