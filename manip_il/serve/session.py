"""A session of the virtual arm: everything that `manip-il serve` opens, in order."""

from __future__ import annotations

import contextlib
import gc
import select
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from manip_il.errors import ManipError
from manip_il.mdp import Actor
from manip_il.serve.cameras import RATE, Cameras
from manip_il.serve.config import SessionConfig
from manip_il.serve.episodes import ServedEpisodes
from manip_il.serve.leader import load_policy, mover_of
from manip_il.serve.operator import INTERRUPT, Operator, weigh_session
from manip_il.serve.station import Station
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.tasks.config import EnvConfig
from manip_il.tasks.envs import env_of

Say = Callable[[str], None]


def serve(
    env: EnvConfig,
    config: SessionConfig,
    command: Sequence[str],
    cameras: CameraConfig | None,
    conditions: Sequence[Condition],
    policy: Path | None,
    say: Say,
    warn: Say,
    *,
    trust: bool,
) -> None:
    """Serve a virtual arm until the program of `command` ends, or until Ctrl-C if there is none.

    cameras: those to serve; None for none. conditions: how worlds vary. policy: folder of the one that moves the
    leader, if any, and whether to `trust` it. say, warn: called with lines for the user. Raises `UsageError` for a
    robot without Feetech servos or a port that is taken, `ManipError` if the program failed, what `mover_of` raises.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.setswitchinterval(5e-4)  # [s]: short enough for the threads of the buses to answer in time
    with contextlib.ExitStack() as stack:
        stack.callback(weigh_session, weigh_session() or "0")
        station = Station(env_of(env, None, conditions), config)
        stack.callback(station.close)
        shown = Cameras(station, cameras, config.camera_port) if cameras is not None else None
        if shown is not None:
            stack.callback(shown.close)
            if shown.rate < RATE:
                warn(f"pictures are drawn {shown.rate:.0f} times a second here; {RATE} need smaller or fewer ones")
        task = station.env.task_description
        leads = load_policy(policy, env, shown, task, trust=trust) if policy is not None else None
        leader = mover_of(config.leader, leads, station, shown)
        episodes = ServedEpisodes(station, env, config.log, config.seed, leader)
        gc.collect()
        gc.freeze()  # a full collection of what LeRobot and torch have imported takes longer than a client waits
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
    """Return lines that say where everything is, one of them to copy."""
    root, port = config.output_dir, config.camera_port
    size = f"width: {cameras.width}, height: {cameras.height}, fps: {RATE}" if cameras else ""
    shown = ", ".join(
        f"{name}: {{type: zmq, server_address: 127.0.0.1, port: {port}, camera_name: {name}, {size}}}"
        for name in (cameras.names if cameras else ())
    )
    seen = f' --robot.cameras="{{{shown}}}"' if shown else ""
    return [
        *(f"{name}: {root / name} (its calibration: {root / name}.json)" for name in station.buses),
        "to record demonstrations of the leader's, as with a real arm:",
        f"lerobot-record --robot.type=so101_follower --robot.port={root}/follower --robot.id=follower "
        f"--robot.calibration_dir={root}{seen} --teleop.type=so101_leader --teleop.port={root}/leader "
        f"--teleop.id=leader --teleop.calibration_dir={root} --dataset.repo_id=local/so101 "
        f'--dataset.single_task="{station.env.task_description}" --dataset.push_to_hub=false',
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
    """Serve clients until Ctrl-C; draw a new world on Enter and, if it `renews`, once the task is solved."""
    station.on_read = episodes.frame
    episodes.begin(Actor.EXPERT)

    def each_step() -> bool:
        pressed = sys.stdin.isatty() and select.select([sys.stdin], [], [], 0)[0] and sys.stdin.readline()
        if pressed or (renews and station.is_solved):
            say(f"seed {station.seed}: {'solved' if station.is_solved else 'left'}; a new world")
            episodes.renew()
            episodes.begin(Actor.EXPERT)
        return True

    with contextlib.suppress(KeyboardInterrupt):
        station.run(each_step)
