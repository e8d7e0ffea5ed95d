"""Simulated control steps per second of the whole reinforcement learning loop, as a share of what
raw physics allows.

python benchmarks/learning_speed.py [--quick]

Ours is GAIL's iteration with 16 environments: act, inverse kinematics, step, observe,
discriminator, PPO, checkpoint. The limit is `mj_step` alone, replaying the same controls from the
same starts. Both alternate iteration by iteration in the same run, in CPU seconds; the result is
the median ratio. Also prints the share without the gradient steps of PPO and of the discriminator.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np
from _machine import describe_machine

from manip_il.chapter.config import LearningConfig
from manip_il.chapter.episodes import RobotEpisode
from manip_il.chapter.learning import LearningRun
from manip_il.cli.main import main as command
from manip_il.collect.workers import Engine
from manip_il.sim.env import ManipEnv
from manip_il.worlds.table import make_config

SCENES = (("panda", "reach"), ("panda", "pick_place"), ("fetch", "pick_place"))
NEVER = 10**9


class Recorded(RobotEpisode):
    """Stores an episode's start and its controls."""

    _env: ManipEnv

    def start(self, seed: int) -> None:
        super().start(seed)
        self.began, self.controls = mujoco.MjData(self._env.world.model), []
        mujoco.mj_copyData(self.began, self._env.world.model, self._env.data)

    def advance(self, action: np.ndarray) -> None:
        super().advance(action)
        self.controls.append(self._env.data.ctrl.copy())

    def replay(self) -> None:
        for control in self.controls:
            self.began.ctrl[:] = control
            mujoco.mj_step(self._env.world.model, self.began, self._env.config.physics_steps)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="few iterations: shows that it runs, measures little"
    )
    iterations = 2 if parser.parse_args().quick else 8
    print(describe_machine())
    print("robot task        steps/s  raw physics, steps/s  share of raw  without gradient steps")
    for robot, task in SCENES:
        with tempfile.TemporaryDirectory() as folder:
            measured = measure(robot, task, Path(folder), iterations)
        whole, acting, raw = np.median(measured, axis=0)
        print(
            f"{robot:5s} {task:10s} {whole:8,.0f}  {raw:20,.0f}  {whole / raw:12.2f} "
            f" {acting / raw:22.2f}"
        )
    return 0


def measure(
    robot: str, task: str, folder: Path, iterations: int
) -> list[tuple[float, float, float]]:
    """Return steps per second of every iteration: the whole loop, rollouts only, physics only."""
    demos = folder / "demos"
    words = [
        f"--robot.type={robot}",
        f"--task.type={task}",
        "--dataset.num_episodes=5",
        f"--dataset.root={demos}",
    ]
    if command(["record", *words, "--workers=1", "--quiet"]):
        raise SystemExit("recording failed")
    env = make_config(robot, task)
    config = LearningConfig(
        method="gail", env=env, datasets=(demos,), episodes=16, steps=NEVER, validation_every=NEVER
    )
    run = LearningRun(config, folder, Engine())
    agent = run.agent()
    recorded = [Recorded(env, None) for _ in range(config.episodes)]
    agent.envs.episodes = recorded
    d = agent.discriminator()
    found = []
    for _ in range(iterations):
        times = [time.process_time()]
        agent.rollouts()
        times.append(time.process_time())
        agent.improve(agent.discriminate(d))
        run.finish(agent)
        times.append(time.process_time())
        for episode in recorded:
            episode.replay()
        times.append(time.process_time())
        acting, learning, raw = np.diff(times)
        simulated = agent.envs.simulated
        found.append((simulated / (acting + learning), simulated / acting, simulated / raw))
    return found


if __name__ == "__main__":
    sys.exit(main())
