"""A session of the virtual arm: everything that `manip-il serve` opens, and in which order."""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import sys
from collections.abc import Callable, Iterator, Sequence

from manip_il.errors import ManipError
from manip_il.seeding import BLOCK, stream_seeds
from manip_il.serve.cameras import Cameras
from manip_il.serve.config import SessionConfig
from manip_il.serve.log import SessionLog
from manip_il.serve.operator import HELD, URGENT, Operator, weigh_session
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
    say: Say,
    warn: Say,
) -> None:
    """Serve a virtual arm until the program of `command` ends, else until Ctrl-C.

    cameras: what is shown; None for none. conditions: what worlds differ in. say, warn: called with lines for the user.
    Raises `UsageError` for a robot without Feetech servos or a port that is taken, `ManipError` if the program failed.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.setswitchinterval(5e-4)  # [s]: the threads of the buses get their turn within it
    with contextlib.suppress(OSError):  # a servo answers within milliseconds, whatever else runs
        os.nice(-URGENT)
    weigh_session()
    with contextlib.ExitStack() as stack:
        station = Station(env_of(env, None, conditions), config)
        stack.callback(station.close)
        for bus in station.buses.values():
            bus.on_refusal = warn
        log = SessionLog(config.log, station, env) if config.log is not None else None
        there = set(log.seeds if log is not None else [])
        seeds = (seed for seed in stream_seeds("demonstrations", BLOCK, config.seed) if seed not in there)
        station.reset(next(seeds))
        gc.collect()
        gc.freeze()  # a collection of all that LeRobot and torch have imported takes longer than a client waits
        stack.callback(gc.unfreeze)
        if cameras is not None:
            shown = Cameras(station, cameras, config.camera_port)
            stack.callback(shown.close, warn)
        for line in described(station, config, cameras):
            say(line)
        if command:
            operator = Operator(command, station, seeds, log, config.intervene)
            stack.callback(operator.kill)
            try:
                station.run(operator.each_step)
            except KeyboardInterrupt:
                operator.stop()
                station.run(operator.each_step)
            say(f"{command[0]} ended; episodes solved {operator.solved}, not solved {operator.failed}")
            if operator.status:
                raise ManipError(f"{command[0]} failed with exit code {operator.status}")
        else:
            _stand(station, config, seeds, log, say)


def described(station: Station, config: SessionConfig, cameras: CameraConfig | None) -> list[str]:
    """Return where everything is, and a line to copy."""
    root = config.output_dir
    shown = ", ".join(
        f"{name}: {{type: zmq, server_address: 127.0.0.1, port: {config.camera_port}, camera_name: {name}, "
        f"width: {cameras.width}, height: {cameras.height}, fps: 30}}"
        for name in (cameras.names if cameras else ())
        if cameras
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


def _stand(station: Station, config: SessionConfig, seeds: Iterator[int], log: SessionLog | None, say: Say) -> None:
    """Serve whoever connects, until Ctrl-C."""
    station.mover = station.expert
    if log is not None:
        log.begin()
        station.on_read = log.frame

    def each_step() -> bool:
        pressed = sys.stdin.isatty() and select.select([sys.stdin], [], [], 0)[0] and sys.stdin.readline()
        if pressed or (config.reset == "solved" and station.solved_for >= HELD):
            say(f"seed {station.seed}: {'solved' if station.env.solved else 'left'}; a new world")
            if log is not None:
                log.end(keep=True)
                log.begin()
            station.reset(next(seeds))
        return True

    with contextlib.suppress(KeyboardInterrupt):
        station.run(each_step)
