"""Labelled control steps per second on one core, as a share of what raw physics allows.

python benchmarks/control_speed.py [--quick]

Ours is a step of a recording rollout: observe, read the state, label it, advance. The limit is
`mj_step` alone, replaying the same controls from the same starts. Both alternate episode by episode
in the same run; the result is the median ratio over the repeats.
"""

import argparse
import sys
import time

import mujoco
import numpy as np
from _machine import describe_machine

from manip_il import Expert
from manip_il.robots import ROBOTS
from manip_il.seeding import stream_seeds
from manip_il.sim.env import ManipEnv
from manip_il.worlds.ladder.world import make_env

STEPS = 30  # steps per episode: how many the expert takes from the start to the goal


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="few episodes: shows that it runs, measures little"
    )
    options = parser.parse_args()
    episodes, repeats = (3, 3) if options.quick else (30, 7)
    print(describe_machine())
    print(
        "robot  labelled control steps/s  raw physics, control steps/s  share of raw (median, all"
        " repeats)"
    )
    for robot in ROBOTS:
        env = make_env(robot, "pick_place")
        expert = Expert(env.scene)
        measured = np.array([repeat(env, expert, episodes) for _ in range(repeats)])
        ours, raw = np.median(measured, axis=0)
        shares = measured[:, 0] / measured[:, 1]
        spread = f"{shares.min():.2f} to {shares.max():.2f}"
        print(f"{robot:5s}  {ours:24,.0f}  {raw:28,.0f}  {np.median(shares):.2f} ({spread})")
    return 0


def repeat(env: ManipEnv, expert: Expert, episodes: int) -> tuple[float, float]:
    """Return control steps per second, ours and raw, alternating over the same episodes."""
    ours = raw = 0.0
    replay = mujoco.MjData(env.scene.model)
    for seed in stream_seeds("certificate", episodes):
        env.start(seed)
        mujoco.mj_copyData(replay, env.scene.model, env.data)
        controls, seconds = record(env, expert)
        ours += seconds
        raw += replay_seconds(env, replay, controls)
        if not np.array_equal(replay.qpos, env.data.qpos):
            raise SystemExit(
                f"seed {seed}: the replay left the recorded trajectory; the two measure different"
                " physics"
            )
    return episodes * STEPS / ours, episodes * STEPS / raw


def record(env: ManipEnv, expert: Expert) -> tuple[np.ndarray, float]:
    """Return the controls of one labelled episode, (STEPS, actuators), and the seconds it took."""
    controls = np.empty((STEPS, env.scene.model.nu))
    started = time.perf_counter()
    for step in range(STEPS):
        env.observe()
        label = expert.label(env.get_state(), env)
        env.advance(label.action)
        controls[step] = env.data.ctrl
    return controls, time.perf_counter() - started


def replay_seconds(env: ManipEnv, data: mujoco.MjData, controls: np.ndarray) -> float:
    model, physics_steps = env.scene.model, env.config.physics_steps
    started = time.perf_counter()
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data, physics_steps)
    return time.perf_counter() - started


if __name__ == "__main__":
    sys.exit(main())
