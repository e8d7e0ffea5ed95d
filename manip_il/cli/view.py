"""`manip-il view`: a robot at its task, live in MuJoCo's viewer, or in Rerun if there is no display."""

from __future__ import annotations

import contextlib
import socket
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il.cli.common_options import OF_POLICY, Tested, Trusting, default_cameras
from manip_il.cli.options import Given, given
from manip_il.cli.progress import say
from manip_il.errors import UsageError
from manip_il.evaluation.suites import suite_conditions
from manip_il.option import Seeded, option
from manip_il.seeding import BLOCK, stream_seeds
from manip_il.tasks.config import EnvConfig

if TYPE_CHECKING:
    from manip_il.collect.rollout import Environment
    from manip_il.evaluation.watch import RerunLog, WindowScreen

IN_A_FILE = 3  # episodes written to a file by default
SIZE = {"height": 240, "width": 320}  # picture size for people [pixels]


@dataclass(frozen=True)
class WatchedPolicyGroup:
    """`--policy.*`: the policy that drives."""

    path: Path | None = option(None, "a checkpoint or a run")
    type: Literal["expert", "random", "sliders"] | None = option(
        None, "who drives instead of a checkpoint, by default the expert; sliders: you, in the window"
    )


@dataclass(frozen=True)
class ViewOptions(Tested, Seeded, Trusting):
    """Watch a robot at its task in MuJoCo's viewer; without a display, in a browser (Rerun) or from a file.

    Episodes run in real time until --n_episodes have ended, the window is closed or Ctrl-C is pressed. The browser
    shows pictures, joints, actions, phase and progress. --output writes these as fast as possible to a file, which
    `rerun FILE.rrd` opens on any machine.
    """

    example: ClassVar[str] = "manip-il view --robot.type=panda --task.type=stack --n_episodes=1 --output=stack.rrd"
    first: ClassVar[str] = "policy.path policy.type robot.type task.type n_episodes output"
    policy: WatchedPolicyGroup = field(default_factory=WatchedPolicyGroup)
    env: Given = given(EnvConfig, **OF_POLICY)
    n_episodes: int | None = option(None, f"episodes; by default unlimited, or {IN_A_FILE} with --output", at_least=1)
    output: Path | None = option(None, "write a Rerun file, FILE.rrd, instead of showing episodes")

    def run(self) -> None:
        """Run episodes and show them."""
        from manip_il.cli.inputs import open_driver
        from manip_il.collect.environments import make_env
        from manip_il.collect.job import RolloutJob, observed_cameras, run_steps
        from manip_il.evaluation.runner import HOLD
        from manip_il.evaluation.watch import outcome
        from manip_il.mdp import LONGEST_EPISODE
        from manip_il.sim.config import FILM, CameraConfig, Look
        from manip_il.sim.window import has_display
        from manip_il.tasks.stock.table import ROBOTS as STOCK

        in_window, sliders = self.output is None and has_display(), self.policy.type == "sliders"
        env, driver, cameras = open_driver(self.policy.path, self.policy.type or "expert", self.env, trust=self.trust)
        in_window = in_window and env.robot not in STOCK
        if sliders and not in_window:
            raise UsageError(
                "--policy.type=sliders opens a window: set DISPLAY and omit --output; not for fetch_stock and aloha"
            )
        if cameras is None and not in_window:  # for people to watch; shadows only in files, which may take longer
            cameras = CameraConfig(default_cameras(env), **SIZE, look=FILM if self.output else Look())
        if sliders and not self.env.get("horizon"):
            env = replace(env, horizon=LONGEST_EPISODE)  # people are slower than the expert
        conditions = suite_conditions(self.suite, env, sees=in_window or cameras is not None)
        job = RolloutJob(env, driver, HOLD, conditions=conditions, cameras=cameras)
        world = make_env(env, observed_cameras(job), conditions)
        seeds = stream_seeds("validation", self.n_episodes or (IN_A_FILE if self.output else BLOCK), self.seed)
        with contextlib.closing(self._screen(world, env, in_window)) as screen:
            for step in run_steps(job, [world], seeds, screen.act):
                if not screen.add(step):
                    break
                if step.done:
                    say(outcome(step))
        if self.output is not None:
            say(f"next: rerun {self.output}")

    def _screen(self, env: Environment, config: EnvConfig, in_window: bool) -> WindowScreen | RerunLog:
        from manip_il.evaluation.watch import RerunLog, WindowScreen
        from manip_il.sim.env import ManipEnv

        if in_window and isinstance(env, ManipEnv):
            return WindowScreen(env, sliders=self.policy.type == "sliders")
        log = RerunLog(config, self.output)
        if log.address:
            ports = " ".join(f"-L {port}:localhost:{port}" for port in log.ports)
            say(f"open: {log.address}", f"from another machine first: ssh {ports} {socket.gethostname()}")
        return log
