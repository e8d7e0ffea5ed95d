"""How the cost of recording, resuming, checking, training and pushing grows with the number of
episodes.

python benchmarks/scale.py [--quick] [--episodes=10000] [--folder=FOLDER] [--plot=FILE]

Fetch's reach, the cheapest task to simulate, on one worker. A recording grows tenfold repeatedly
with `record --resume=true`; at every size each command runs whole, in a new process. Measures CPU
time, which depends little on the machine's other load. A new episode: the time of recording minus
that of adding one episode, which reads all others back and writes the same dataset, divided by the
number of new episodes. Memory: the process's peak. Resuming: wall time until a new episode is on
disk. At the largest size: the wall time of a new episode relative to that of the same one in an
empty folder, alternating.
"""

import argparse
import json
import math
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path

from _machine import describe_machine

from manip_il.collect.job import RolloutJob
from manip_il.collect.record import collect
from manip_il.collect.workers import Engine
from manip_il.data.journal import episode_path, list_seeds
from manip_il.worlds.table import make_config

FIRST = 100
TURNS = 3
ENVIRONMENT = ("--robot.type=fetch", "--task.type=reach", "--workers=1")
COMMANDS = ("record", "resume", "check", "info", "train", "push", "pull")
ROWS = "rows.json"


@dataclass(frozen=True)
class Run:
    """One command: wall and CPU time [s], and peak memory [MiB]."""

    wall: float
    processor: float
    memory: float


@dataclass(frozen=True)
class Row:
    """All commands on a dataset of a given size. new: CPU time for one more episode [s].

    resumed: wall time [s].
    """

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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="ten episodes: shows that it runs, measures little"
    )
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument(
        "--folder",
        type=Path,
        help="folder that keeps the results and is continued from; by default a temporary one",
    )
    parser.add_argument(
        "--plot", type=Path, help="file for a plot of all measurements in the folder"
    )
    options = parser.parse_args()
    most, first = (10, 10) if options.quick else (options.episodes, FIRST)
    print(describe_machine())
    print(
        "one entry: processor time, memory; of resuming: wall time until a new episode is on disk"
    )
    print(
        f"{'episodes':>9}  " + "  ".join(f"{name:>18}" for name in ("new episode", *COMMANDS[1:])),
        flush=True,
    )
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
                (folder / ROWS).write_text(
                    json.dumps([asdict(row) for row in rows], indent=1) + "\n"
                )
            count *= 10
        ratios = against_empty(folder, 5 if options.quick else 1_000)
        print(
            f"at {rows[-1].episodes:,}, a new episode's time as a multiple of one in an empty"
            " folder: ",
            end="",
        )
        print(f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})")
        if options.plot is not None:
            draw(rows, options.plot)
    return 0


def read_rows(folder: Path) -> list[Row]:
    if not (folder / ROWS).is_file():
        return []
    rows = json.loads((folder / ROWS).read_text())
    return [
        Row(**row | {"runs": {name: Run(**run) for name, run in row["runs"].items()}})
        for row in rows
    ]


def measure(root: Path, count: int, before: int) -> Row:
    """Grow a dataset from `before` to `count` episodes, and measure all commands on it."""
    recorded = manip_il(*record(root, count))
    more, resumed = resume(root, count + 1)
    fresh = (recorded.processor - more.processor) / (count - before)
    return Row(count, fresh, resumed, {"record": recorded, "resume": more} | others(root))


def others(root: Path) -> dict[str, Run]:
    """Measure the commands that only read a dataset."""
    away, back = root.with_name("remote"), root.with_name("back")
    opened = f"Dataset.open(Path({str(root)!r})).count_successes()"
    info = f"from pathlib import Path; from manip_il.data.dataset import Dataset; {opened}"
    runs = {
        "check": manip_il("data", "check", str(root)),
        "info": measured([sys.executable, "-c", info]),
        "train": manip_il(
            "train", f"--dataset.root={root}", "--steps=1", f"--output_dir={root.with_name('run')}"
        ),
        "push": manip_il("push", str(root), f"file://{away}"),
        "pull": manip_il("pull", f"file://{away}", str(back)),
    }
    for path in (away, back, root.with_name("run")):
        shutil.rmtree(path)
    return runs


def against_empty(folder: Path, episodes: int) -> list[float]:
    """Return the time of new episodes beside all journals, relative to that of the same ones in
    an empty folder.
    """
    journals, empty = folder / "demos.journals", folder / "empty"
    job, after = RolloutJob(make_config("fetch", "reach"), hold=10), max(list_seeds(journals)) + 1
    ratios: list[float] = []
    empty.mkdir()
    collect_seconds(job, range(after, after + 5), empty)  # the first call loads and compiles
    for turn in range(TURNS):
        seeds = range(after + turn * episodes, after + (turn + 1) * episodes)
        order = (journals, empty) if turn % 2 else (empty, journals)
        seconds = {place: collect_seconds(job, seeds, place) for place in order}
        ratios.append(seconds[journals] / seconds[empty])
    empty.rmdir()
    return ratios


def collect_seconds(job: RolloutJob, seeds: range, journals: Path) -> float:
    """Return the seconds to simulate episodes and store their journals, which are then deleted."""
    started = time.perf_counter()
    for _ in collect(Engine(), job, seeds, journals):
        pass
    seconds = time.perf_counter() - started
    for seed in seeds:
        episode_path(journals, seed).unlink()
    return seconds


def draw(rows: list[Row], path: Path) -> None:
    """Plot time and memory against the number of episodes, with their growth over the last
    decade in the legend.
    """
    plt = import_module("matplotlib.pyplot")
    figure, both = plt.subplots(1, 2, figsize=(11, 4.8), layout="constrained")
    sizes = [row.episodes for row in rows]
    times = {
        "one new episode": [row.new for row in rows],
        "resume, until a new one is on disk": [row.resumed for row in rows],
    }
    times |= {name: [row.runs[name].processor for row in rows] for name in COMMANDS[2:]}
    held = {name: [row.runs[name].memory for row in rows] for name in COMMANDS}
    for axes, drawn in zip(both, (times, held), strict=True):
        # a command has the same colour on both sides
        for number, (name, values) in enumerate(drawn.items()):
            power = math.log10(values[-1] / values[-2]) if len(values) > 1 else 0.0
            axes.plot(
                sizes,
                values,
                "o-",
                color=f"C{number}",
                label=f"{name}: n$^{{{max(power, 0.0):.2f}}}$",
            )
        axes.set(xscale="log", xlabel="episodes n")
        axes.grid(alpha=0.3)
        axes.legend(
            fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.15), frameon=False
        )
    both[0].set(yscale="log", ylabel="time [s]", title="Processor time of a command")
    both[1].set(ylabel="memory [MiB]", title="Most memory held", ylim=(0, None))
    figure.savefig(path, dpi=110)


def record(root: Path, count: int) -> tuple[str, ...]:
    resumes = root.with_name(f"{root.name}.journals").exists()
    sizes = (
        f"--dataset.root={root}",
        f"--dataset.num_episodes={count}",
        f"--resume={str(resumes).lower()}",
    )
    return "record", *ENVIRONMENT, *sizes


def resume(root: Path, count: int) -> tuple[Run, float]:
    """Record one more episode; return the run, and how long it took until that was on disk [s]."""
    journals = root.with_name(f"{root.name}.journals")
    started, had = time.time(), {path.name for path in os.scandir(journals)}
    run = manip_il(*record(root, count))
    [new] = [
        path
        for path in os.scandir(journals)
        if path.name not in had and path.name.endswith(".mcap")
    ]
    return run, new.stat().st_mtime - started


def manip_il(*words: str) -> Run:
    """Run a command in a new process. Raises `SystemExit` if it fails."""
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
