"""Samples per second for image training: decoded once and memory-mapped, against LeRobot's video
DataLoader.

python benchmarks/image_loading.py [DATASET] [--quick]

DATASET is the root of a dataset with cameras; without it one with two 128 x 128 cameras is
recorded. Batches of 64 in shuffled order, all columns of the dataset, pictures as float32 in [0,
1]; ours on one thread, LeRobot's in this process and in two worker processes, of which the faster
counts. All are warm: our frames are decoded, and every process has run an epoch. LeRobot's pictures
are unchanged in both rows: augmentation is extra work of ours. The last line is the time to decode
all frames once, in epochs of LeRobot's loader. All alternate in the same run; the result is the
median ratio of the repeats.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from _machine import describe_machine
from lerobot.datasets import LeRobotDataset

import datasets
from manip_il.data.camera import decode
from manip_il.data.dataset import Dataset
from manip_il.learn.batches import Augment, to_float
from manip_il.learn.network import threads
from manip_il.learn.samples import Samples, Windows

BATCH = 64
SECONDS = 2.0  # duration of each of our measurements [s]
ROWS = {"plain": None, "augmented": Augment()}


@dataclass(frozen=True)
class Repeat:
    """Samples/s of LeRobot's two modes, and of ours by row; seconds to decode all frames."""

    peers: tuple[float, float]
    ours: dict[str, float]
    build: float


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path, nargs="?")
    parser.add_argument(
        "--quick", action="store_true", help="few episodes, one repeat: shows that it runs"
    )
    options = parser.parse_args()
    print(describe_machine())
    datasets.disable_progress_bars()
    with tempfile.TemporaryDirectory() as folder:
        root = options.dataset or record(Path(folder) / "dataset", 4 if options.quick else 20)
        with threads(1):
            repeats = measure(root, 1 if options.quick else 5)
        report(root, repeats)
    return 0


def record(root: Path, episodes: int) -> Path:
    words = [
        "record",
        "--cameras=front,wrist",
        f"--dataset.num_episodes={episodes}",
        f"--dataset.root={root}",
    ]
    command = "import sys; from manip_il.cli.main import main; sys.exit(main())"
    subprocess.run([sys.executable, "-c", command, *words], check=True, capture_output=True)
    return root


def measure(root: Path, repeats: int) -> list[Repeat]:
    # start LeRobot's worker processes first: if forked after decoding, they would share open files
    peers = [epochs(root, workers) for workers in (2, 0)]
    for peer in peers:
        next(peer)
    source = our_samples(root)
    rows = {
        name: partial(our_epoch, source, augment, iter(range(10**9)))
        for name, augment in ROWS.items()
    }
    for epoch in rows.values():
        epoch()
    results: list[Repeat] = []
    for _ in range(repeats):
        pace = (next(peers[0]), next(peers[1]))
        ours = {name: samples_per_s(epoch) for name, epoch in rows.items()}
        results.append(Repeat(pace, ours, build_time(root)))
    return results


def epochs(root: Path, workers: int) -> Iterator[float]:
    """Yield samples/s of LeRobot's loader for every epoch; the first one also starts it."""
    dataset = LeRobotDataset("manip/benchmark", root=root)
    loader = torch.utils.data.DataLoader(
        dataset, BATCH, shuffle=True, num_workers=workers, persistent_workers=workers > 0
    )
    while True:
        started = time.perf_counter()
        samples = sum(len(batch["index"]) for batch in loader)
        yield samples / (time.perf_counter() - started)


def our_samples(root: Path) -> Samples:
    dataset = Dataset.open(root)
    table = {key: values for key, values in dataset.columns().items() if values.dtype != object}
    columns = {key: torch.from_numpy(np.array(values)) for key, values in table.items()}
    pictures = {camera: decode([dataset.camera(camera)]) for camera in dataset.cameras}
    windows, tasks, rows = (
        Windows(table["episode_index"], {}),
        [*dataset.tasks.values()],
        np.arange(len(dataset)),
    )
    return Samples(windows, columns, pictures, np.array(tasks, object), rows, rows[:0])


def our_epoch(samples: Samples, augment: Augment | None, number: Iterator[int]) -> int:
    """Run one epoch in a new order; return the number of samples."""
    count, seed = len(samples.windows.episodes), next(number)
    order = np.random.default_rng(seed).permutation(count)
    generator = torch.Generator().manual_seed(seed)
    for rows in np.split(order, range(BATCH, count, BATCH)):
        batch = samples.batch(rows)
        if augment is None:
            batch |= {key: to_float(batch[key]) for key in samples.pictures}
        else:
            for key in samples.pictures:
                batch[key] = augment(batch[key], generator)
    return count


def samples_per_s(epoch: Callable[[], int]) -> float:
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < SECONDS:
        count += epoch()
    return count / (time.perf_counter() - started)


def build_time(root: Path) -> float:
    """Return the seconds that decoding all frames takes."""
    started = time.perf_counter()
    our_samples(root)
    return time.perf_counter() - started


def report(root: Path, repeats: list[Repeat]) -> None:
    keys, frames = Dataset.open(root).cameras, len(Dataset.open(root).columns(["index"])["index"])
    print(
        f"{frames} frames of {len(keys)} cameras, batches of {BATCH}; samples/s, medians; ratios'"
        " medians and ranges"
    )
    print("pictures    LeRobot, 0 processes   2 processes       ours   ours / LeRobot's best")
    two, none = (statistics.median(repeat.peers[way] for repeat in repeats) for way in (0, 1))
    for name in ROWS:
        ours = statistics.median(repeat.ours[name] for repeat in repeats)
        ratios = summary([repeat.ours[name] / max(repeat.peers) for repeat in repeats])
        print(f"{name:10}  {none:20,.0f}  {two:12,.0f}  {ours:9,.0f}   {ratios}")
    build = statistics.median(repeat.build for repeat in repeats)
    share = summary([repeat.build * max(repeat.peers) / frames for repeat in repeats])
    print(
        f"decoding once: {len(keys) * frames / build:,.0f} pictures/s; in epochs of LeRobot's best:"
        f" {share}"
    )


def summary(ratios: list[float]) -> str:
    return f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"


if __name__ == "__main__":
    sys.exit(main())
