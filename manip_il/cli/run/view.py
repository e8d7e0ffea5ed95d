"""Run `manip-il view`: a robot at its task, live in MuJoCo's viewer, or in Rerun if there is no
display.
"""

import contextlib
import socket
from typing import Any

from manip_il.cli.common_options import default_cameras
from manip_il.cli.outputs import say
from manip_il.cli.robots import IN_A_FILE, ViewOptions
from manip_il.collect.job import HOLD, RolloutJob, observed_cameras, run_steps
from manip_il.evaluation.measuring import open_driver
from manip_il.evaluation.suites import suite_conditions
from manip_il.evaluation.watch import RerunLog, WindowScreen, outcome
from manip_il.seeding import BLOCK, stream_seeds
from manip_il.sim.config import FILM, CameraConfig, Look
from manip_il.sim.view import has_display
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import env_spec, make_env

SIZE = {"height": 240, "width": 320}  # picture size for people [pixels]


def run_view(options: ViewOptions) -> None:
    """Run episodes and show them."""
    env, driver, cameras = open_driver(
        options.policy.path, options.env, options.policy.type or "expert", trust=options.trust
    )
    can_open = options.output is None and has_display()
    in_window = can_open and "shown in a window" in env_spec(env).can
    # for people to watch; shadows only in files, which may take longer
    if cameras is None and not in_window:
        cameras = CameraConfig(
            default_cameras(env), **SIZE, look=FILM if options.output else Look()
        )
    conditions = suite_conditions(options.suite, env, sees=in_window or cameras is not None)
    job = RolloutJob(env, driver, HOLD, conditions=conditions, cameras=cameras)
    world = make_env(env, observed_cameras(job), conditions)
    seeds = stream_seeds(
        "validation", options.n_episodes or (IN_A_FILE if options.output else BLOCK), options.seed
    )
    with contextlib.closing(_screen(options, world, env, in_window)) as screen:
        for step in run_steps(job, [world], seeds):
            if not screen.add(step):
                break
            if step.done:
                say(outcome(step))
    if options.output is not None:
        say(f"next: rerun {options.output}")


def _screen(
    options: ViewOptions, env: Any, config: EnvConfig, in_window: bool
) -> WindowScreen | RerunLog:
    if in_window:
        return WindowScreen(env)
    log = RerunLog(config, options.output)
    if log.address:
        ports = " ".join(f"-L {port}:localhost:{port}" for port in log.ports)
        say(
            f"open: {log.address}",
            f"from another machine first: ssh {ports} {socket.gethostname()}",
        )
    return log
