"""Frames per second written to a LeRobot dataset: our writer against LeRobot's own loop, on the
same frames.

python benchmarks/writer_speed.py [--quick]

Ours is `write_dataset`; the peer is `add_frame` per frame, `save_episode` per episode and
`finalize`, with its pictures encoded after every episode (its default) or while it records
(streaming). Both end with the whole dataset on disk and use LeRobot's default video settings. They
alternate in the same run; the result is the median ratio over the repeats. The peer's time per
episode grows with its video file, ours does not, so the ratio is larger for longer datasets.
"""

import argparse
import logging
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from _machine import describe_machine
from lerobot.datasets import LeRobotDataset

import datasets
from manip_il.data import schema as s
from manip_il.data.lerobot_write import write_dataset
from manip_il.data.video import VideoConfig
from manip_il.mdp import Episode

LENGTH = 100  # frames per episode
REPO = "someone/benchmark"
STATE_ONLY = s.EnvironmentSpec(
    robot="benchmark",
    task="benchmark",
    fps=25,
    joint_names=tuple(f"joint_{index}" for index in range(8)),
    environment_state_names=tuple(f"number_{index}" for index in range(20)),
    sim_state_size=60,
    instruction="Measure.",
)
FILMED = replace(STATE_ONLY, cameras=("front", "wrist"), image_size=(128, 128))

Write = Callable[[Path, s.EnvironmentSpec, list[Episode]], None]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="few episodes: shows that it runs, measures little"
    )
    options = parser.parse_args()
    repeats = 1 if options.quick else 3
    datasets.disable_progress_bars()
    logging.disable(logging.WARNING)
    os.environ["SVT_LOG"] = "1"  # otherwise the peer's encoders print a greeting
    print(describe_machine())
    print(
        "dataset                            LeRobot, frames/s  ours, frames/s  ratio (median, all"
        " repeats)"
    )
    for name, spec, episodes, peer in (
        ("state only", STATE_ONLY, 20, peer_default),
        ("two 128 x 128 cameras, default", FILMED, 6, peer_default),
        ("two 128 x 128 cameras, streaming", FILMED, 6, peer_streaming),
    ):
        frames = [make_episode(spec, seed) for seed in range(2 if options.quick else episodes)]
        measured = np.array(
            [[rate(write, spec, frames) for write in (peer, ours)] for _ in range(repeats)]
        )
        ratios = measured[:, 1] / measured[:, 0]
        theirs, mine = np.median(measured, axis=0)
        spread = f"{ratios.min():.1f} to {ratios.max():.1f}"
        print(f"{name:33s}  {theirs:17,.0f}  {mine:14,.0f}  {np.median(ratios):.1f} ({spread})")
    return 0


def rate(write: Write, spec: s.EnvironmentSpec, episodes: list[Episode]) -> float:
    """Return frames per second, from nothing to a whole dataset."""
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        write(Path(folder) / "dataset", spec, episodes)
        return sum(map(len, episodes)) / (time.perf_counter() - started)


def ours(root: Path, spec: s.EnvironmentSpec, episodes: list[Episode]) -> None:
    write_dataset(episodes, root, spec, fingerprint={}, video=VideoConfig("libsvtav1"))


def peer_default(
    root: Path, spec: s.EnvironmentSpec, episodes: list[Episode], streaming: bool = False
) -> None:
    dataset = LeRobotDataset.create(
        REPO,
        int(spec.fps),
        s.features(spec),
        root=root,
        robot_type=spec.robot,
        use_videos=bool(spec.cameras),
        streaming_encoding=streaming,
        encoder_queue_maxsize=LENGTH,  # it drops frames if its queue is full
    )
    for episode in episodes:
        for frame in range(len(episode)):
            row = {key: values[frame] for key, values in episode.columns.items()}
            dataset.add_frame(row | {"task": spec.instruction})
        dataset.save_episode()
    dataset.finalize()


def peer_streaming(root: Path, spec: s.EnvironmentSpec, episodes: list[Episode]) -> None:
    peer_default(root, spec, episodes, streaming=True)


def make_episode(spec: s.EnvironmentSpec, seed: int) -> Episode:
    rng = np.random.default_rng(seed)
    columns = {key: column(rng, feature) for key, feature in s.features(spec).items()}
    columns[s.SEED][:] = seed
    columns[s.SUCCESS][:] = False
    return Episode(seed, columns, success=False, success_at_end=False)


def column(rng: np.random.Generator, feature: dict) -> np.ndarray:
    """Return slow random walks, as arms move little between frames.

    In pictures a square moves on a gradient.
    """
    shape = (LENGTH, *feature["shape"])
    if feature["dtype"] == "video":
        return film(rng, *feature["shape"][:2])
    if feature["dtype"].startswith("float"):
        return (rng.normal(size=shape).cumsum(axis=0) / 100).astype(feature["dtype"])
    return rng.integers(0, 2, shape).astype(feature["dtype"])


def film(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width]
    still = np.stack([rows + columns, 2 * rows, 2 * columns], axis=-1) // 2 + rng.integers(
        0, 4, (height, width, 3)
    )
    frames = np.repeat(still[None].astype(np.uint8), LENGTH, axis=0)
    for t, frame in enumerate(frames):
        frame[40:70, t % (width - 30) :][:, :30] = (200, 40, 30)
    return frames


if __name__ == "__main__":
    sys.exit(main())
