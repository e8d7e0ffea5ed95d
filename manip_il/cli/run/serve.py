"""Run `manip-il serve`: a virtual SO-101 behind serial ports, for LeRobot's own programs."""

from dataclasses import replace

from manip_il.cli.outputs import save_options, say
from manip_il.cli.robots import ServeOptions
from manip_il.collect.inputs import env_config
from manip_il.data.atomic import exclusive, output_of, require_ours
from manip_il.errors import UsageError, requires
from manip_il.evaluation.suites import varied
from manip_il.serve.config import SessionConfig

with requires("serve", "'manip_il[serve]'"):
    from manip_il.serve.session import serve

SERVO = "servo"  # a value of --vary

_IDLE = ("late", "random_actions", "dynamics")  # conditions that do not affect a served arm


def run_serve(options: ServeOptions) -> None:
    """Serve until the program ends or the user presses Ctrl-C."""
    env = env_config(options.env)
    cameras = options.camera_config(env) if options.cameras else None
    if idle := [one for one in options.vary if one in _IDLE]:
        raise UsageError(f"--vary={idle[0]} changes nothing for a served arm; use --vary=servo")
    conditions = varied(
        [one for one in options.vary if one != SERVO], env, sees=cameras is not None
    )
    session = SessionConfig(**options.session, varies=SERVO in options.vary)
    with exclusive(session.output_dir):
        require_ours(session.output_dir, output_of("Serve"))
        save_options(session.output_dir, replace(options, command=[]))  # which may hold secrets
        serve(env, session, options.command, cameras, conditions, say)
