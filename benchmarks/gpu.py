"""Speed on a CUDA GPU: training from pictures against LeRobot's loader and loop, acting, and
rendering by EGL.

python benchmarks/gpu.py

Samples/s of ACT (two cameras of 96 x 96 and of 240 x 240 pixels; one of 480 x 640 for aloha, if
gym_aloha is installed), diffusion and cnn (96 x 96), batches of 32, mixed precision if the policy
supports it: for `manip_il`'s trainer, which decodes pictures once, and for LeRobot's DataLoader
with one process per core (at most 8), its processors and updates as in `lerobot-train`. Both after
a warm-up, alternating, on the same dataset of videos. Then milliseconds per action for 25 episodes
in lockstep, on GPU and CPU, and pictures/s of the renderer. At most 8 minutes. Without a GPU it
prints a message and exits with 0.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from manip_il.worlds.ladder.world import make_env

os.environ.setdefault("MUJOCO_GL", "egl")  # must be set before MuJoCo is imported

import numpy as np
import torch
from _machine import describe_machine
from accelerate import Accelerator
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies.factory import make_policy, make_pre_post_processors

import datasets
from manip_il.data.dataset import Dataset
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.train import Trainer
from manip_il.sim import render
from manip_il.sim.config import CameraConfig

BATCH, EPISODES_AT_ONCE = 32, 25
SECONDS, REPEATS = 5.0, 3  # duration [s] and number of measurements
LIMIT = 7 * 60  # [s] after which no further row is started
ACT = {"type": "act", "use_amp": True, "pretrained_backbone_weights": None}
DIFFUSION = {
    "type": "diffusion",
    "use_amp": True,
    "pretrained_backbone_weights": None,
    "crop_shape": [84, 84],
}
# pictures of each dataset [pixels]
SIZES = {"small": (96, 96), "large": (240, 240), "aloha": (480, 640)}
ALOHA = ["--robot.type=aloha", "--task.type=AlohaTransferCube-v0", "--cameras=top"]
ROWS: dict[str, tuple[str, dict[str, Any]]] = {
    "act, 96 pixels": ("small", ACT),
    "act, 240 pixels": ("large", ACT),
    "act, aloha, 480 x 640": ("aloha", ACT),
    "diffusion, 96 pixels": ("small", DIFFUSION),
    "cnn, 96 pixels": ("small", {"type": "cnn"}),
}


def main() -> int:
    if not torch.cuda.is_available():
        print(
            "torch sees no CUDA card here: nothing to measure; see benchmarks/image_loading.py for"
            " a CPU"
        )
        return 0
    datasets.disable_progress_bars()
    began = time.monotonic()
    print(f"{torch.cuda.get_device_name()}; {describe_machine()}")
    print(
        f"training, batches of {BATCH}: samples/s   LeRobot's      ours   ratio (range)   ms an"
        " action: card, CPU"
    )
    with tempfile.TemporaryDirectory() as folder:
        names = [name for name in SIZES if name != "aloha" or find_spec("gym_aloha")]
        roots = {name: record(Path(folder) / name, name) for name in names}
        for name, (data, options) in ROWS.items():
            if data not in roots:
                continue
            if time.monotonic() - began > LIMIT:
                break
            config = FitConfig(
                {**options, "device": "cuda"},
                observation="images",
                steps=10**6,
                batch_size=BATCH,
                log_freq=10**9,
            )
            trainer = Trainer((Dataset.open(roots[data]),), config, Path(folder) / name)
            steps = trainer.run(), lerobots_steps(roots[data], trainer)
            pairs = [
                tuple(BATCH * per_s(partial(next, step)) for step in steps) for _ in range(REPEATS)
            ]
            trainer.save()
            saved = Path(folder) / name / "checkpoints/last/pretrained_model"
            # on a CPU a plan takes a minute
            devices = ("cuda",) if options is DIFFUSION else ("cuda", "cpu")
            times = [milliseconds_an_action(saved, device, SIZES[data]) for device in devices]
            print(row(name, pairs, times), flush=True)
        for size in (96, 240):
            print(
                f"drawing, {size} x {size} pixels, {os.environ['MUJOCO_GL']}:"
                f" {pictures_per_s(size):,.0f}/s"
            )
    print(f"{time.monotonic() - began:.0f} s")
    return 0


def record(root: Path, name: str) -> Path:
    height, width = SIZES[name]
    words = [
        "record",
        f"--image.height={height}",
        f"--image.width={width}",
        f"--dataset.root={root}",
    ]
    words += [
        "--dataset.num_episodes=20",
        *(ALOHA if name == "aloha" else ["--cameras=front,wrist"]),
    ]
    command = "import sys; from manip_il.cli.main import main; sys.exit(main())"
    subprocess.run([sys.executable, "-c", command, *words], check=True, capture_output=True)
    return root


def lerobots_steps(root: Path, ours: Trainer) -> Iterator[None]:
    """Yield after each update as in lerobot-train, with the same options."""
    config: Any = ours.pipeline.policy
    meta: Any = LeRobotDataset("manip/benchmark", root=root).meta
    dataset = LeRobotDataset(
        "manip/benchmark", root=root, delta_timestamps=resolve_delta_timestamps(config, meta)
    )
    workers = min(8, len(os.sched_getaffinity(0)))
    loader = torch.utils.data.DataLoader(
        dataset,
        BATCH,
        shuffle=True,
        drop_last=True,
        num_workers=workers,
        pin_memory=True,
        persistent_workers=True,
    )
    policy = make_policy(config, ds_meta=meta).train()
    before, _ = make_pre_post_processors(config, dataset_stats=meta.stats)
    preset: Any = ours.pipeline.optimizer
    optimizer: Any = preset.build(policy.get_optim_params())
    accelerator = Accelerator(mixed_precision=ours.accelerator.mixed_precision)
    policy, optimizer = accelerator.prepare(policy, optimizer)
    while True:
        for batch in loader:
            with accelerator.autocast():
                loss, _ = policy.forward(before(batch))
            accelerator.backward(loss)
            accelerator.clip_grad_norm_(policy.parameters(), 10.0)
            optimizer.step()
            optimizer.zero_grad()
            loss.item()
            yield


def per_s(call: Callable[[], object]) -> float:
    """Return calls per second, after two warm-up calls."""
    for _ in range(2):
        call()
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < SECONDS:
        call()
        count += 1
    torch.cuda.synchronize()
    return count / (time.perf_counter() - started)


def milliseconds_an_action(path: Path, device: str, size: tuple[int, int]) -> float:
    policy, rng = LearnedPolicy.load(path, device), np.random.default_rng(0)
    states = rng.normal(size=(EPISODES_AT_ONCE, policy.checkpoint.action)).astype(np.float32)
    shape = (EPISODES_AT_ONCE, *size, 3)
    images = {camera: rng.integers(256, size=shape, dtype=np.uint8) for camera in policy.cameras}
    around = np.empty((EPISODES_AT_ONCE, 0), np.float32)
    return 1e3 / (EPISODES_AT_ONCE * per_s(lambda: policy.act(states, around, images)))


def pictures_per_s(size: int) -> float:
    env, config = make_env(), CameraConfig(("front", "wrist"), size, size)
    env.start(0)
    draw = partial(render.pictures, env.scene, env.data, config)
    return len(config.names) * per_s(draw)


def row(name: str, pairs: list[tuple[float, ...]], times: list[float]) -> str:
    ours, theirs = (statistics.median(pair[way] for pair in pairs) for way in (0, 1))
    ratios = sorted(own / peer for own, peer in pairs)
    spread = f"{statistics.median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})"
    return (
        f"{name:38} {theirs:12,.0f} {ours:9,.0f}   {spread:18}"
        f" {', '.join(f'{one:.2f}' for one in times):>10}"
    )


if __name__ == "__main__":
    sys.exit(main())
