"""Run `manip-il view`: a robot at its task, in MuJoCo's viewer or in a file of Rerun's."""

import contextlib
from typing import Any

from manip_il.cli.common_options import default_cameras
from manip_il.cli.outputs import say
from manip_il.cli.robots import IN_A_FILE, ViewOptions
from manip_il.collect.job import HOLD, RolloutJob, observed_cameras, run_steps
from manip_il.evaluation.measuring import open_driver
from manip_il.evaluation.suites import suite_conditions
from manip_il.evaluation.watch import RerunLog, WindowScreen, outcome
from manip_il.seeding import BLOCK, stream_seeds
from manip_il.sim.config import FILM, CameraConfig
from manip_il.worlds.table import env_spec, make_env

SIZE = {"height": 240, "width": 320}  # picture size for people [pixels]


def run_view(options: ViewOptions) -> None:
    """Run episodes and show them."""
    env, driver, cameras = open_driver(
        options.policy.path, options.env, options.policy.type or "expert", trust=options.trust
    )
    if options.output is None:
        env_spec(env).require("shown in a window", "give --output=FILE.rrd")
    elif cameras is None:
        cameras = CameraConfig(default_cameras(env), **SIZE, look=FILM)
    conditions = suite_conditions(options.suite, env, sees=True)
    job = RolloutJob(env, driver, HOLD, conditions=conditions, cameras=cameras)
    world: Any = make_env(env, observed_cameras(job), conditions)
    count = options.n_episodes or (IN_A_FILE if options.output else BLOCK)
    seeds = stream_seeds("validation", count, options.seed)
    screen = RerunLog(env, options.output) if options.output else WindowScreen(world)
    with contextlib.closing(screen):
        for step in run_steps(job, [world], seeds):
            if not screen.add(step):
                break
            if step.done:
                say(outcome(step))
    if options.output is not None:
        say(f"next: rerun {options.output}", f"in a browser: rerun --web-viewer {options.output}")
