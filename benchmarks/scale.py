"""How recording, resuming, checking, training and pushing grow with the number of episodes.

python benchmarks/scale.py [--quick] [--episodes=10000] [--folder=FOLDER] [--plot=FILE]

Fetch's reach, the cheapest to simulate, on one worker. A recording grows tenfold again and again by
`record --resume=true`; at every size each command runs whole, as a process of its own. Processor time, as it does not
depend on what else the machine does. A new episode: what recording takes beyond a recording of one episode more, which
reads all others back and writes the same dataset. Memory: the most that the process held. Resuming: wall time until a
new episode is on disk.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path

from _machine import describe_machine

FIRST = 100
ENVIRONMENT = ("--robot.type=fetch", "--task.type=reach", "--workers=1")
COMMANDS = ("record", "resume", "doctor", "info", "train", "push", "pull")
ROWS = "rows.json"


@dataclass(frozen=True)
class Run:
    """One command: wall and processor time [s], and the most memory that it held [MiB]."""

    wall: float
    processor: float
    memory: float


@dataclass(frozen=True)
class Row:
    """All commands on a dataset of so many episodes. new: what one more takes [s of processor time]."""

    episodes: int
    new: float
    resumed: float
    runs: dict[str, Run]

    def __str__(self) -> str:
        record, resume, *others = (self.runs[name] for name in COMMANDS)
        cells = [
            f"{1000 * self.new:6.1f} ms {record.memory:5,.0f} MiB",
            f"{self.resumed:6.1f} s {resume.memory:5,.0f} MiB",
            *(f"{one.processor:6.1f} s {one.memory:5,.0f} MiB" for one in others),
        ]
        return f"{self.episodes:9,d}  " + "  ".join(f"{text:>18}" for text in cells)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="ten episodes: shows that it runs, measures little")
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument(
        "--folder", type=Path, help="where it works, leaves what it made, and goes on with what is there"
    )
    parser.add_argument("--plot", type=Path, help="a picture of all that was measured in the folder")
    options = parser.parse_args()
    most, first = (10, 10) if options.quick else (options.episodes, FIRST)
    print(describe_machine())
    print("one entry: processor time, memory; of resuming: wall time until a new episode is on disk")
    print(f"{'episodes':>9}  " + "  ".join(f"{name:>18}" for name in ("new episode", *COMMANDS[1:])), flush=True)
    with tempfile.TemporaryDirectory(dir=options.folder) as temporary:
        folder = options.folder or Path(temporary)
        rows, count = read_rows(folder), first
        for row in rows:
            print(row)
        while count <= most:
            if all(row.episodes != count for row in rows):
                before = rows[-1].episodes + 1 if rows else 0
                rows.append(measure(folder / "demos", count, before))
                print(rows[-1], flush=True)
                (folder / ROWS).write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
            count *= 10
        if options.plot is not None:
            draw(rows, options.plot)
    return 0


def read_rows(folder: Path) -> list[Row]:
    if not (folder / ROWS).is_file():
        return []
    rows = json.loads((folder / ROWS).read_text())
    return [Row(**row | {"runs": {name: Run(**run) for name, run in row["runs"].items()}}) for row in rows]


def measure(root: Path, count: int, before: int) -> Row:
    """Let a dataset of `before` episodes grow to `count`, and measure all commands on it."""
    recorded = manip_il(*record(root, count))
    more, resumed = resume(root, count + 1)
    fresh = (recorded.processor - more.processor) / (count - before)
    return Row(count, fresh, resumed, {"record": recorded, "resume": more} | others(root))


def others(root: Path) -> dict[str, Run]:
    """Measure the commands that only read a dataset."""
    away, back = root.with_name("remote"), root.with_name("back")
    info = f"from pathlib import Path; from manip_il.data.lerobot_read import dataset_info as i; i(Path({str(root)!r}))"
    runs = {
        "doctor": manip_il("doctor", str(root)),
        "info": measured([sys.executable, "-c", info]),
        "train": manip_il("train", f"--dataset.root={root}", "--steps=1", f"--output_dir={root.with_name('run')}"),
        "push": manip_il("push", str(root), f"file://{away}"),
        "pull": manip_il("pull", f"file://{away}", str(back)),
    }
    for path in (away, back, root.with_name("run")):
        shutil.rmtree(path)
    return runs


def draw(rows: list[Row], path: Path) -> None:
    """Time and memory over the number of episodes, on logarithmic axes."""
    plt = import_module("matplotlib.pyplot")
    figure, (time_axes, memory_axes) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    sizes = [row.episodes for row in rows]
    times = {
        "one new episode": [row.new for row in rows],
        "until a resumed one is on disk": [row.resumed for row in rows],
    }
    times |= {name: [row.runs[name].processor for row in rows] for name in COMMANDS[2:]}
    for name, seconds in times.items():
        time_axes.loglog(sizes, seconds, "o-", label=name)
    for name in ("record", *COMMANDS[2:]):
        memory_axes.semilogx(sizes, [row.runs[name].memory for row in rows], "o-", label=name)
    time_axes.set(xlabel="episodes", ylabel="time [s]", title="Processor time of a command")
    memory_axes.set(xlabel="episodes", ylabel="memory [MiB]", title="Most memory held", ylim=(0, None))
    for axes in (time_axes, memory_axes):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


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


def measured(words: list[str]) -> Run:
    started = time.perf_counter()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(words)} failed")
    return Run(time.perf_counter() - started, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


if __name__ == "__main__":
    sys.exit(main())
