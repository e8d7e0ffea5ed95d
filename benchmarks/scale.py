"""How recording, resuming, checking, training and pushing grow with the number of episodes.

python benchmarks/scale.py [--quick] [--episodes=10000] [--folder=FOLDER]

Fetch's reach, the cheapest to simulate, on one worker. A recording grows tenfold again and again by
`record --resume=true`; at every size each command runs whole, as a process of its own. Processor time, as it does not
depend on what else the machine does. A new episode: what recording takes beyond a recording of one episode more, which
reads all others back and writes the same dataset. Memory: the most that the process held. Resuming: wall time until a
new episode is on disk.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from _machine import describe_machine

FIRST = 100
ENVIRONMENT = ("--robot.type=fetch", "--task.type=reach", "--workers=1")
COLUMNS = ("record", "resume", "doctor", "info", "train", "push", "pull")


@dataclass(frozen=True)
class Run:
    """One command: wall and processor time [s], and the most memory that it held [MiB]."""

    wall: float
    processor: float
    memory: float


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="ten episodes: shows that it runs, measures little")
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--folder", type=Path, help="where it works, and leaves what it made")
    options = parser.parse_args()
    most, first = (10, 10) if options.quick else (options.episodes, FIRST)
    print(describe_machine())
    print("one entry: processor time, memory; of resuming: wall time until a new episode is on disk")
    print(f"{'episodes':>9}  {'new episode':>20}  " + "  ".join(f"{name:>17}" for name in COLUMNS[1:]), flush=True)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        root, before, count = Path(options.folder or folder) / "demos", 0, first
        while count <= most:
            print(row(root, count, before), flush=True)
            before, count = count + 1, 10 * count
    return 0


def row(root: Path, count: int, before: int) -> str:
    """Let a dataset of `before` episodes grow to `count`, measure all commands on it, and return a line."""
    recorded = manip_il(*record(root, count))
    more, resumed = resume(root, count + 1)
    fresh = (recorded.processor - more.processor) / (count - before)
    away, back = root.with_name("remote"), root.with_name("back")
    runs = [
        manip_il("doctor", str(root)),
        python(
            f"from pathlib import Path; from manip_il.data.lerobot_read import dataset_info as i; i(Path('{root}'))"
        ),
        manip_il("train", f"--dataset.root={root}", "--steps=1", f"--output_dir={root.with_name('run')}"),
        manip_il("push", str(root), f"file://{away}"),
        manip_il("pull", f"file://{away}", str(back)),
    ]
    for path in (away, back, root.with_name("run")):
        shutil.rmtree(path)
    new = f"{1000 * fresh:6.1f} ms {recorded.memory:5,.0f} MiB"
    shown = [
        f"{resumed:6.1f} s {more.memory:5,.0f} MiB",
        *(f"{one.processor:6.1f} s {one.memory:5,.0f} MiB" for one in runs),
    ]
    return f"{count:9,d}  {new:>20}  " + "  ".join(f"{text:>17}" for text in shown)


def record(root: Path, count: int) -> tuple[str, ...]:
    resumes = root.with_name(f"{root.name}.journals").exists()
    sizes = f"--dataset.root={root}", f"--dataset.num_episodes={count}", f"--resume={str(resumes).lower()}"
    return "record", *ENVIRONMENT, *sizes


def resume(root: Path, count: int) -> tuple[Run, float]:
    """Record one episode more; returns the run, and how long it took until that was on disk [s]."""
    journals = root.with_name(f"{root.name}.journals")
    started, had = time.time(), {path.name for path in os.scandir(journals)}
    run = manip_il(*record(root, count))
    [new] = [path for path in os.scandir(journals) if path.name not in had and path.name.endswith(".mcap")]
    return run, new.stat().st_mtime - started


def manip_il(*words: str) -> Run:
    """Run a command in a process of its own. Raises `SystemExit` where it fails."""
    return measured([str(Path(sys.executable).with_name("manip-il")), *words, "--quiet"])


def python(code: str) -> Run:
    return measured([sys.executable, "-c", code])


def measured(words: list[str]) -> Run:
    started = time.perf_counter()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(words)} failed")
    return Run(time.perf_counter() - started, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


if __name__ == "__main__":
    sys.exit(main())
