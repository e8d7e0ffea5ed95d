"""A session of the virtual arm: open the ports, cameras, leader and program of `manip-il serve`,
and close them.
"""

import contextlib
import gc
import select
import signal
import sys
from collections.abc import Callable, Sequence

from manip_il.errors import ManipError, UsageError
from manip_il.mdp import Actor
from manip_il.serve.cameras import RATE, Cameras
from manip_il.serve.config import SessionConfig
from manip_il.serve.episodes import ServedEpisodes
from manip_il.serve.operator import INTERRUPT, Operator, weigh_session
from manip_il.serve.station import Station
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.ladder.world import WORLD
from manip_il.worlds.table import env_spec, world_of

Say = Callable[[str], None]


def serve(
    env: EnvConfig,
    config: SessionConfig,
    command: Sequence[str],
    cameras: CameraConfig | None,
    conditions: Sequence[Condition],
    say: Say,
) -> None:
    """Serve a virtual arm until a program ends, or until Ctrl-C if there is none.

    Args:
        env: The environment.
        config: Options of the session.
        command: The program and its arguments; empty for none.
        cameras: The cameras to serve, if any.
        conditions: How worlds vary.
        say: Called with lines for the user.

    Raises:
        UsageError: If the robot has no Feetech servos, or the cameras' port is taken.
        RenderError: If there is no off-screen OpenGL for the cameras.
        ManipError: If the program failed.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.setswitchinterval(5e-4)  # [s]: short enough for the threads of the buses to answer in time
    with contextlib.ExitStack() as stack:
        stack.callback(weigh_session, weigh_session() or "0")
        if world_of(env.robot) is not WORLD:
            raise UsageError(f"{env_spec(env).robot} has no Feetech servos; choose another robot")
        station = Station(env, config, conditions)
        stack.callback(station.close)
        if cameras is not None:
            stack.callback(Cameras(station, cameras, config.camera_port).close)
        leader = station.expert if config.leader == "expert" else lambda: None
        episodes = ServedEpisodes(station, env, config.log, config.seed, leader)
        gc.collect()
        # a full collection of what LeRobot and torch have imported takes longer than a client waits
        gc.freeze()
        stack.callback(gc.unfreeze)
        for line in described(station, config, cameras):
            say(line)
        if command:
            operator = Operator(command, station, episodes, config.intervene)
            stack.callback(operator.kill)
            _operate(operator, station, command[0], say)
        else:
            _stand(station, episodes, config.reset == "solved", say)


def described(station: Station, config: SessionConfig, cameras: CameraConfig | None) -> list[str]:
    """Return lines for the user about an open session.

    Args:
        station: The station.
        config: Options of the session.
        cameras: The cameras that are served, if any.

    Returns:
        The ports, their calibration files, and a `lerobot-record` command to copy.
    """
    root, port = config.output_dir, config.camera_port
    size = f"width: {cameras.width}, height: {cameras.height}, fps: {RATE}" if cameras else ""
    shown = ", ".join(
        f"{name}: {{type: zmq, server_address: 127.0.0.1, port: {port}, camera_name: {name},"
        f" {size}}}"
        for name in (cameras.names if cameras else ())
    )
    seen = f' --robot.cameras="{{{shown}}}"' if shown else ""
    return [
        *(f"{name}: {root / name} (its calibration: {root / name}.json)" for name in station.buses),
        "to record what the leader demonstrates, as with a real arm:",
        f"lerobot-record --robot.type=so101_follower --robot.port={root}/follower"
        " --robot.id=follower "
        f"--robot.calibration_dir={root}{seen} --teleop.type=so101_leader"
        f" --teleop.port={root}/leader "
        f"--teleop.id=leader --teleop.calibration_dir={root} --dataset.repo_id=local/so101 "
        f'--dataset.single_task="{station.env.task_description}" --dataset.push_to_hub=false '
        f"--dataset.fps={station.env.config.control_hz}",
    ]


def _operate(operator: Operator, station: Station, program: str, say: Say) -> None:
    """Run a program to its end; on Ctrl-C it may save what is complete."""
    try:
        station.run(operator.each_step)
    except KeyboardInterrupt:
        operator.press(INTERRUPT)
        station.run(operator.each_step)
    say(f"{program} ended; episodes solved {operator.solved}, not solved {operator.failed}")
    if operator.status:
        raise ManipError(f"{program} failed with exit code {operator.status}")


def _stand(station: Station, episodes: ServedEpisodes, renews: bool, say: Say) -> None:
    """Serve clients until Ctrl-C.

    Draw a new world on Enter and, if `renews`, once the task is solved.
    """
    station.on_read = episodes.frame
    episodes.begin(Actor.EXPERT)

    def each_step() -> bool:
        pressed = (
            sys.stdin.isatty() and select.select([sys.stdin], [], [], 0)[0] and sys.stdin.readline()
        )
        if pressed or (renews and station.is_solved):
            say(
                f"seed {station.seed}: {'solved' if station.is_solved else 'not solved'}; drawing a"
                " new world"
            )
            episodes.renew()
            episodes.begin(Actor.EXPERT)
        return True

    with contextlib.suppress(KeyboardInterrupt):
        station.run(each_step)
