"""`manip-il serve`: a virtual SO-101 behind serial ports, for LeRobot's own programs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

from manip_il.cli.common_options import Trusting, Varied
from manip_il.cli.options import Given, given
from manip_il.cli.outputs import kind_of_output, save_options
from manip_il.cli.progress import say
from manip_il.data.ownership import require_ours
from manip_il.errors import UnknownName, UsageError
from manip_il.evaluation.policy_folder import find_policy
from manip_il.evaluation.suites import varied
from manip_il.option import option
from manip_il.serve.config import LEADERS, ServoConfig, SessionConfig
from manip_il.tasks.config import EnvConfig

SERVO = "servo"  # a value of --vary

_IDLE = ("late", "random_actions", "dynamics")  # conditions that do not affect a served arm


@dataclass(frozen=True)
class ServeOptions(Varied, Trusting):
    """Run a simulated SO-101 behind serial ports, which LeRobot's own programs open like those of a real arm.

    Prints both ports, the cameras, and a command line to copy. With `-- COMMAND ...` it runs that program on the ports
    and presses its keys as a person would: an episode ends when the task is solved, and a failed one is recorded
    again. --vary=servo also varies the servos. A policy as the leader (--leader=runs/lift) sets the default task and
    cameras.
    """

    example: ClassVar[str] = "manip-il serve --task.type=lift --cameras=front,wrist"
    first: ClassVar[str] = "task.type cameras leader servo log output_dir"
    command: list[str] = option(list, "a LeRobot program and its options, after `--`", positional=True)
    env: Given = given(EnvConfig, robot="so101")
    session: Given = given(SessionConfig, prefix="")
    servos: ServoConfig = field(default_factory=ServoConfig)

    def run(self) -> None:
        """Serve until the program ends or the user presses Ctrl-C."""
        from manip_il.cli.inputs import open_driver
        from manip_il.data.atomic import exclusive
        from manip_il.serve.session import serve
        from manip_il.sim.window import has_display

        leader, policy = self.session.get("leader", LEADERS[0]), None
        if leader not in LEADERS:
            if not (path := Path(leader).expanduser()).exists():
                raise UnknownName("leader", leader, (*LEADERS, "the folder of a policy"))
            policy = find_policy(path)
        if leader == "sliders" and not has_display():
            raise UsageError("--leader=sliders opens a window, which needs a display; set DISPLAY")
        env, _, seen = open_driver(policy, "expert", self.env, trust=self.trust)
        cameras = self.camera_config(env) if self.cameras else seen
        if idle := [one for one in self.vary if one in _IDLE]:
            raise UsageError(f"--vary={idle[0]} changes nothing for a served arm; use --servos.*, or --vary=servo")
        conditions = varied([one for one in self.vary if one != SERVO], env, sees=cameras is not None)
        session = SessionConfig(**self.session, servos=self.servos, varies=SERVO in self.vary)
        with exclusive(session.output_dir):
            require_ours(session.output_dir, kind_of_output(self))
            save_options(session.output_dir, replace(self, command=[]))  # which may hold secrets
            serve(env, session, self.command, cameras, conditions, policy, say, trust=self.trust)
