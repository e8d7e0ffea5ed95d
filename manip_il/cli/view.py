"""`manip-il view`: a robot at its task, live in MuJoCo's viewer, or in Rerun where there is no display."""

from __future__ import annotations

import contextlib
import socket
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il.cli import common_options as common
from manip_il.cli.inputs import exists, open_driver
from manip_il.cli.options import Given
from manip_il.cli.progress import say, warn
from manip_il.errors import RenderError, UsageError
from manip_il.option import option
from manip_il.tasks.stock.table import ROBOT as STOCK

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob
    from manip_il.evaluation.watch import RerunLog, WindowScreen
    from manip_il.sim.config import CameraConfig
    from manip_il.sim.env import ManipEnv
    from manip_il.tasks.config import EnvConfig

HOLD = 10  # control steps that an episode goes on for after success
IN_A_FILE = 3  # episodes, if nobody says how many
SIZE = (240, 320)  # of pictures that no policy looks at [pixels]
SUFFIX = ".rrd"


@dataclass
class WatchedPolicyGroup:
    """`--policy.*` of what drives."""

    path: Path | None = common.policy_option()
    type: Literal["expert", "random", "sliders"] | None = option(
        None, "instead of a checkpoint; sliders: those of the window; by default expert"
    )


@dataclass
class ViewOptions:
    """Watch a robot at its task: in MuJoCo's viewer, without a display in a browser (Rerun), or from a file.

    Shows episodes in real time until the window is closed, Ctrl-C, or so many. Without a display it serves the pictures
    of the cameras, joints, actions, phase and progress to a browser; `--output` writes them to a file for `rerun
    FILE.rrd`, on any machine, as fast as they come.
    """

    example: ClassVar[str] = "manip-il view --robot.type=panda --task.type=stack --n_episodes=1 --output=stack.rrd"
    first: ClassVar[str] = "policy.path policy.type robot.type task.type n_episodes output"
    policy: WatchedPolicyGroup = field(default_factory=WatchedPolicyGroup)
    env: Given = common.env_given(of_policy=True)
    suite: str = common.suite_option()
    n_episodes: int | None = option(None, f"episodes; by default without end, {IN_A_FILE} in a file", at_least=1)
    seed: int = common.seed_option()
    trust: bool = common.trust_option()
    output: Path | None = option(None, "write a file of Rerun's, FILE.rrd, in place of showing anything")

    def check(self) -> None:
        """Refuse what does not go together."""
        if self.policy.path is not None and self.policy.type is not None:
            raise UsageError("give one of --policy.path=DIR and --policy.type=expert|random|sliders")
        if self.output is not None and (self.output.suffix != SUFFIX or self.output.is_dir()):
            raise UsageError(f"--output is {self.output}; expected a file, NAME{SUFFIX}")
        if self.output is not None:
            exists(f"the folder of --output={self.output}")(self.output.parent)
        if self.env.get("robot") == STOCK:
            raise UsageError(f'--robot.type={STOCK} cannot be viewed; gymnasium shows it: render_mode="human"')
        if self.policy.type == "sliders" and not self._in_a_window:
            raise UsageError("--policy.type=sliders needs a window: a DISPLAY, and no --output")

    def run(self) -> None:
        """Run episodes and show them."""
        from manip_il.collect.job import observed_cameras, run_steps
        from manip_il.evaluation.watch import outcome
        from manip_il.seeding import BLOCK, stream_seeds
        from manip_il.tasks.envs import env_of

        job = self._job()
        seeds = stream_seeds("validation", self.n_episodes or (IN_A_FILE if self.output else BLOCK), self.seed)
        env = env_of(job.env, observed_cameras(job), job.conditions)
        with contextlib.closing(self._screen(env, job.env)) as screen:
            for step in run_steps(job, [env], seeds, screen.act):
                if not screen.add(step):
                    break
                if step.done:
                    say(outcome(step))
        if self.output is not None:
            say(f"next: rerun {self.output}")

    @property
    def _in_a_window(self) -> bool:
        from manip_il.sim.window import has_display

        return self.output is None and has_display()

    def _job(self) -> RolloutJob:
        """Return the episodes to show; without pictures if no policy looks at any and a window is open."""
        from manip_il.collect.job import RolloutJob
        from manip_il.evaluation.suites import suite_conditions
        from manip_il.mdp import LONGEST_EPISODE

        env, driver, cameras = open_driver(self.policy.path, self.policy.type or "expert", self.env, trust=self.trust)
        if cameras is None and not self._in_a_window:
            cameras = self._cameras(env)
        conditions = suite_conditions(self.suite, env, sees=cameras is not None)
        if self.policy.type == "sliders" and not self.env.get("horizon"):
            env = replace(env, horizon=LONGEST_EPISODE)  # nobody is as fast as the expert
        return RolloutJob(env, driver, HOLD, conditions=conditions, cameras=cameras)

    def _cameras(self, env: EnvConfig) -> CameraConfig | None:
        """Return cameras for people, with shadows if nobody waits; None, with a warning, without OpenGL."""
        from manip_il.sim.config import CAMERAS, FILM, CameraConfig, Look
        from manip_il.tasks.envs import env_of

        cameras = CameraConfig(CAMERAS, *SIZE, FILM if self.output else Look())
        try:
            env_of(env, cameras).reset(seed=0)
        except RenderError as error:
            warn(f"shown without pictures: {error}")
            return None
        return cameras

    def _screen(self, env: ManipEnv, config: EnvConfig) -> WindowScreen | RerunLog:
        from manip_il.evaluation.watch import RerunLog, WindowScreen

        if self._in_a_window:
            return WindowScreen(env, sliders=self.policy.type == "sliders")
        log = RerunLog(config, self.output)
        if log.address:
            ports = " ".join(f"-L {port}:localhost:{port}" for port in log.ports)
            say(f"open: {log.address}")
            say(f"from another machine first: ssh {ports} {socket.gethostname()}")
        return log
