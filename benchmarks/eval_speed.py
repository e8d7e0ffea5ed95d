"""Evaluation of a state-based policy: control steps per second against raw physics, episodes
against lerobot-eval.

python benchmarks/eval_speed.py [--quick]

The limit is `mj_step` alone, replaying the same controls from the same starts on one core,
alternating in the same run; the result is the median ratio over the repeats. The peer is the whole
command `lerobot-eval`, with videos off, on the same checkpoint and seeds, in the faster of its two
modes (environments in its own process, or in processes of their own), against the whole command
`manip-il eval`; both may use every core. Outcomes must agree seed by seed, except for a diffusion
policy (`configs/diffusion_state.yaml`, a tenth of its steps), which draws from its own seeds.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np
from _machine import describe_machine

from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_write import write_dataset
from manip_il.evaluation.results import EvalResult
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.train import Trainer
from manip_il.mdp import Episode
from manip_il.robots import ROBOTS
from manip_il.seeding import stream_seeds
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.ladder.world import LadderEnv
from manip_il.worlds.table import env_spec, make_config

BIN = Path(sys.executable).parent
TASK = "pick_place"
BATCH = 50  # lerobot-eval's default batch size; smaller ones took longer


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="few episodes: shows that it runs, measures little"
    )
    quick = parser.parse_args().quick
    print(describe_machine())
    with tempfile.TemporaryDirectory() as folder:
        policies = {robot: fitted(robot, Path(folder) / robot, quick) for robot in ROBOTS}
        print(
            "robot  control steps/s  raw physics, control steps/s  share of raw (median, all"
            " repeats)"
        )
        for robot, policy in policies.items():
            measured = np.array(
                [
                    against_physics(robot, policy, 5 if quick else 50)
                    for _ in range(2 if quick else 7)
                ]
            )
            ours, raw = np.median(measured, axis=0)
            shares = measured[:, 0] / measured[:, 1]
            spread = f"{shares.min():.2f} to {shares.max():.2f}"
            print(f"{robot:5s}  {ours:15,.0f}  {raw:28,.0f}  {np.median(shares):.2f} ({spread})")
        print("whole commands, panda          seconds  episodes/s")
        against_lerobot(policies["panda"], Path(folder) / "mlp", 10 if quick else 500)
        print("whole commands, diffusion      seconds  episodes/s")
        diffusion = denoising(Path(folder) / "denoising", quick)
        against_lerobot(diffusion, Path(folder) / "diffusion", 4 if quick else 100, draws=True)
    return 0


def fitted(robot: str, folder: Path, quick: bool) -> Path:
    """Return a policy cloned from 200 demonstrations, which solves nearly all episodes, like one
    in real use.
    """
    count, steps = (10, 50) if quick else (200, 4_000)
    config = make_config(robot, TASK)
    demos = RolloutJob(config, hold=5).run(stream_seeds("demonstrations", count))
    write_dataset(demos, folder / "dataset", env_spec(config), fingerprint={})
    return Trainer((Dataset.open(folder / "dataset"),), FitConfig(steps=steps), folder).fit()


def against_physics(robot: str, policy: Path, episodes: int) -> tuple[float, float]:
    """Return control steps per second on one core, ours and raw, over the same episodes."""
    job = RolloutJob(make_config(robot, TASK), PolicyDriver.of(policy), label="last")
    started = time.perf_counter()
    found = list(job.run(stream_seeds("test", episodes)))
    ours = time.perf_counter() - started
    steps = sum(map(len, found))
    return steps / ours, steps / sum(replay_seconds(job.env, episode) for episode in found)


def replay_seconds(config: EnvConfig, episode: Episode) -> float:
    env = LadderEnv(config)
    env.start(episode.seed)
    scene, data = env.scene, env.data
    controls = np.zeros((len(episode), scene.model.nu))
    for control, action in zip(controls, episode.columns["executed_action"], strict=True):
        action = scene.actions.clip(action, 0)
        control[scene.arm_ctrl], opening = scene.actions.split(action)
        control[scene.gripper.ctrl] = scene.gripper.command(opening)
    started = time.perf_counter()
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(scene.model, data, config.physics_steps)
    return time.perf_counter() - started


def denoising(folder: Path, quick: bool) -> Path:
    """Return a diffusion policy trained on 50 demonstrations."""
    demos, steps = folder / "demos", 2 if quick else 1_600
    config = Path(__file__).parent.parent / "configs" / "diffusion_state.yaml"
    seconds(
        [
            "manip-il",
            "record",
            f"--dataset.num_episodes={4 if quick else 50}",
            f"--dataset.root={demos}",
        ]
    )
    words = [
        "manip-il",
        "train",
        f"--config_path={config}",
        f"--dataset.root={demos}",
        f"--steps={steps}",
    ]
    seconds([*words, f"--output_dir={folder / 'run'}"])
    return folder / "run" / "checkpoints" / "last" / "pretrained_model"


def against_lerobot(policy: Path, folder: Path, episodes: int, draws: bool = False) -> None:
    """Time whole commands, alternating. draws: whether the policy samples, so that outcomes
    differ.
    """
    ours: list[float] = []
    theirs: list[float] = []
    success = ""
    for turn in range(2):
        ours.append(seconds(ours_words(policy, folder / f"ours_{turn}", episodes)))
        result = EvalResult.read(folder / f"ours_{turn}")
        success = str(result.success)
        print(f"manip-il eval                  {ours[-1]:7.1f}  {episodes / ours[-1]:10.1f}")
        for asynchronous in (False, True) if turn == 0 else (False,):
            out = folder / f"theirs_{turn}_{asynchronous}"
            theirs.append(seconds(lerobot_words(policy, out, episodes, asynchronous)))
            name = f"lerobot-eval, {'in processes' if asynchronous else 'in one process'}"
            print(f"{name:29s}  {theirs[-1]:7.1f}  {episodes / theirs[-1]:10.1f}")
            if draws:
                continue
            metrics = json.loads((out / "eval_info.json").read_text())["per_task"][0]["metrics"]
            pairs = zip(metrics["successes"], result.episodes, strict=True)
            if differing := sum(a != b.success for a, b in pairs):
                print(f"  {differing} of {episodes} outcomes differ")
    faster = min(theirs) / np.mean(ours)
    print(f"ours is {faster:.1f} x as fast as lerobot-eval at its best; {success} success")


def ours_words(policy: Path, out: Path, episodes: int) -> list[str]:
    return [
        "manip-il",
        "eval",
        f"--policy.path={policy}",
        f"--eval.n_episodes={episodes}",
        "--eval.films=0",
    ] + [f"--output_dir={out}"]


def lerobot_words(policy: Path, out: Path, episodes: int, asynchronous: bool) -> list[str]:
    seed = stream_seeds("test", 1)[0]
    env = [
        "discover_packages_path=manip_il.lerobot_plugin",
        "type=manip_il",
        "task=PandaPickPlace-v0",
        "render_mode=none",
    ]
    evaluation = [
        f"n_episodes={episodes}",
        f"batch_size={min(BATCH, episodes)}",
        f"use_async_envs={str(asynchronous).lower()}",
    ]
    words = ["lerobot-eval", f"--policy.path={policy}", f"--seed={seed}", f"--output_dir={out}"]
    return words + [f"--env.{word}" for word in env] + [f"--eval.{word}" for word in evaluation]


def seconds(words: list[str]) -> float:
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "CUDA_VISIBLE_DEVICES": ""}
    started = time.perf_counter()
    done = subprocess.run(
        [str(BIN / words[0]), *words[1:]],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} failed:\n{(done.stdout + done.stderr)[-3000:]}")
    return time.perf_counter() - started


if __name__ == "__main__":
    sys.exit(main())
