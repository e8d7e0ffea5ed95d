"""Time to render one picture, against the unmodified physics model and against the scene without
its robot.

python benchmarks/picture_speed.py [--quick]

Ours is `manip_il.sim.render.pictures`, pose and antialiasing included. The peer is
`mujoco.Renderer` on the simulated model, with its shadow map and OpenGL's antialiasing; the limit
is `mujoco.Renderer` without the robot's meshes, without shadows and with one sample per pixel. All
render the same states at the same size, alternating, with one OpenGL context at a time; the result
is the median ratio over the repeats.
"""

import argparse
import copy
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

from _machine import describe_machine

from manip_il import Expert
from manip_il.mdp import State
from manip_il.robots import ROBOTS
from manip_il.seeding import stream_seeds
from manip_il.sim import render
from manip_il.sim.config import CAMERAS, FILM, CameraConfig, Look
from manip_il.sim.env import ManipEnv
from manip_il.sim.scene import camera_id
from manip_il.worlds.ladder.world import make_env

SIZES = ((128, 128), (240, 320), (480, 640))
STATES = 6  # number of states from one expert episode, evenly spaced
APART = 5  # control steps between them
HIDDEN = 5  # a geom group that is not rendered


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="one size, one repeat: shows that it runs, measures little",
    )
    options = parser.parse_args()
    sizes, repeats = (SIZES[:1], 1) if options.quick else (SIZES, 5)
    print(describe_machine())
    print("medians and ranges of all repeats")
    print(
        "robot  camera  height x width  look     ours [ms]  as it is / ours       ours / no robot"
    )
    for robot in ROBOTS:
        env = make_env(robot)
        states = visited(env)
        for height, width in sizes:
            for camera in CAMERAS:
                for name, look in (("default", Look()), ("film", FILM)):
                    config = CameraConfig((camera,), height, width, look)
                    row = [repeat(env, states, config) for _ in range(repeats)]
                    shown = f"{robot:5s}  {camera:6s}  {height:6d} x {width:<5d}  {name:7s}"
                    print(
                        f"{shown}  {statistics.median(one[0] for one in row) * 1e3:9.1f} "
                        f" {summary(row)}",
                        flush=True,
                    )
    return 0


def summary(row: list[tuple[float, float, float]]) -> str:
    """Return the two ratios, each with its range."""
    texts: list[str] = []
    for ratios in (
        [as_it_is / ours for ours, as_it_is, _ in row],
        [ours / no_robot for ours, _, no_robot in row],
    ):
        texts.append(
            f"{statistics.median(ratios):4.1f} ({min(ratios):.1f} to {max(ratios):.1f})".ljust(20)
        )
    return "  ".join(texts).rstrip()


def visited(env: ManipEnv) -> list[State]:
    """Return states of an expert episode."""
    expert = Expert(env.scene)
    states: list[State] = []
    env.start(stream_seeds("certificate", 1)[0])
    for step in range(STATES * APART):
        states += [env.get_state()] if step % APART == 0 else []
        env.advance(expert.label(env.get_state()).action)
    return states


def repeat(env: ManipEnv, states: list[State], config: CameraConfig) -> tuple[float, float, float]:
    """Return seconds per picture: ours, the unmodified physics model, the scene without its
    robot.
    """
    import mujoco  # after our import, which chooses the OpenGL backend

    ours = seconds(env, states, lambda: render.pictures(env.scene, env.data, config))
    render.close()
    no_robot = copy.copy(env.scene.model)
    no_robot.geom_group[no_robot.geom_type == mujoco.mjtGeom.mjGEOM_MESH] = HIDDEN
    no_robot.vis.quality.shadowsize = no_robot.vis.quality.offsamples = 0
    return ours, plain(env, states, config, env.scene.model), plain(env, states, config, no_robot)


def plain(env: ManipEnv, states: list[State], config: CameraConfig, model: Any) -> float:
    """Return seconds per picture with `mujoco.Renderer`."""
    import mujoco

    with closing(mujoco.Renderer(model, config.height, config.width)) as renderer:

        def draw() -> None:
            mujoco.mj_camlight(env.scene.model, env.data)
            renderer.update_scene(env.data, camera=camera_id(env.scene.model, config.names[0]))
            renderer.render()

        return seconds(env, states, draw)


def seconds(env: ManipEnv, states: list[State], draw: Callable[[], object]) -> float:
    """Return the median time of one call over the states, after a warm-up call."""
    env.set_state(states[0])
    draw()
    times: list[float] = []
    for state in states:
        env.set_state(state)
        started = time.perf_counter()
        draw()
        times.append(time.perf_counter() - started)
    return statistics.median(times)


if __name__ == "__main__":
    sys.exit(main())
