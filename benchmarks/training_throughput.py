"""Samples per second of training: our in-memory path against LeRobot's DataLoader, on the same data
in the same run.

python benchmarks/training_throughput.py [DATASET]

DATASET is the root of a local LeRobot dataset with our columns; without it a small one is made with
LeRobot's own API. Prints samples/s of loading and of a whole optimisation step, and the ratios.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors

import datasets
from manip_il.data.dataset import Dataset
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, LABEL_VALID, STATE, features
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.mlp import MLPConfig
from manip_il.learn.network import threads
from manip_il.learn.train import Trainer
from manip_il.worlds.contract import EnvironmentSpec

BATCH = 512
SECONDS = 3.0  # duration of each measurement [s]
LEARNING = (STATE, ENVIRONMENT_STATE, ACTION, LABEL_VALID)


def main() -> None:
    datasets.disable_progress_bars()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(sys.argv[1]) if len(sys.argv) > 1 else make_dataset(Path(folder) / "dataset")
        dataset = LeRobotDataset("manip/benchmark", root=root)
        with threads(1):
            peer_feed, peer_step = lerobot_path(dataset)
            our_feed, our_step = our_path(root, Path(folder) / "run")
            rates = [samples_per_s(step) for step in (peer_feed, our_feed, peer_step, our_step)]
    print(f"{dataset.num_frames} frames, batches of {BATCH}, one thread, samples/s:")
    for what, peer, ours in (("feeding", *rates[:2]), ("optimisation step", *rates[2:])):
        print(
            f"{what:18} LeRobot's DataLoader {peer:11,.0f}   ours {ours:11,.0f}   ratio"
            f" {ours / peer:8.1f}"
        )


def lerobot_path(dataset: LeRobotDataset) -> tuple[Callable[[], object], Callable[[], object]]:
    """Return functions that load a batch with LeRobot's loader, and that also update as
    lerobot-train does.
    """
    config = MLPConfig()
    policy = make_policy(config, ds_meta=dataset.meta)
    before, _ = make_pre_post_processors(config)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=config.optimizer_lr)  # as in LeRobot
    batches = endless(torch.utils.data.DataLoader(dataset, BATCH, shuffle=True, drop_last=True))

    def step() -> None:
        loss, _ = policy.forward(before(next(batches)))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        optimizer.step()
        optimizer.zero_grad()
        loss.item()

    return lambda: before(next(batches)), step


def our_path(root: Path, folder: Path) -> tuple[Callable[[], object], Callable[[], object]]:
    """Return functions that gather a batch in memory, in the form of LeRobot's processors, and
    that also update.
    """
    config = FitConfig(steps=10**9, batch_size=BATCH, log_freq=10**9)
    trainer = Trainer((Dataset.open(root),), config, folder)
    updates, counter = trainer.run(), iter(range(10**9))
    return lambda: trainer.preprocessor(trainer.batch(next(counter))), lambda: next(updates)


def samples_per_s(step: Callable[[], object]) -> float:
    for _ in range(2):
        step()
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < SECONDS:
        step()
        count += 1
    return count * BATCH / (time.perf_counter() - started)


def endless(loader: torch.utils.data.DataLoader):
    while True:
        yield from loader


def make_dataset(
    root: Path, episodes: int = 20, length: int = 100, n: int = 8, k: int = 30
) -> Path:
    rng = np.random.default_rng(0)
    joints, things = tuple(f"joint_{i}" for i in range(n)), tuple(f"number_{i}" for i in range(k))
    spec = EnvironmentSpec("benchmark", "benchmark", 25, joints, things, 1, "benchmark")
    columns = {key: value for key, value in features(spec).items() if key in LEARNING}
    dataset = LeRobotDataset.create(
        "manip/benchmark", int(spec.fps), columns, root=root, use_videos=False
    )
    for _ in range(episodes):
        for _ in range(length):
            state = rng.normal(size=n).astype(np.float32)
            frame = {
                STATE: state,
                ENVIRONMENT_STATE: rng.normal(size=k).astype(np.float32),
                ACTION: 0.9 * state,
            }
            dataset.add_frame(frame | {LABEL_VALID: np.ones(1, np.int64), "task": spec.instruction})
        dataset.save_episode()
    dataset.finalize()
    return root


if __name__ == "__main__":
    main()
