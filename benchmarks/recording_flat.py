"""Seconds an episode and memory over ten thousand recorded episodes: the last must cost what the first did.

python benchmarks/recording_flat.py [--episodes=10000]

Fetch's reach, the cheapest to simulate, on one worker by `manip-il record`'s own path: simulate, label, journal,
dataset, and the dataset's end, with exact statistics over all frames. Every thousand episodes: seconds an episode,
and resident memory of the process.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from _machine import describe_machine

from manip_il.data.build import Recording
from manip_il.engine.engine import Engine
from manip_il.engine.jobs import RolloutJob
from manip_il.recording import collect, provenance, record
from manip_il.seeding import stream_seeds
from manip_il.sim.env import EnvConfig

PARTS = 10
MIB = 1024 * 1024


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=10_000)
    count = parser.parse_args().episodes
    print(describe_machine())
    job = RolloutJob(EnvConfig("fetch", "reach"), "expert", beta=1.0, hold=10)
    part = count // PARTS
    clock: list[float] = []
    memory: list[float] = []

    def seen(_: object) -> None:
        clock.append(time.perf_counter())
        if len(clock) % part == 0:
            memory.append(resident())
            print(
                f"{len(clock):6,d} episodes: {pace(clock[-part:]):.4f} s an episode, {memory[-1]:,.0f} MiB", flush=True
            )

    with tempfile.TemporaryDirectory() as folder:
        root, journals = Path(folder) / "demos", Path(folder) / "demos.journals"
        episodes = collect(Engine(), job, stream_seeds("certificate", count), journals, seen)
        info, _ = record(episodes, journals, root, job, Recording("local/x", provenance=provenance(job)))
        end, after = time.perf_counter() - clock[-1], resident()
    total = clock[-1] - clock[0] + end
    print(f"end of the dataset ({info.frames:,} frames): {end:.1f} s, {end / total:.1%} of all; {after:,.0f} MiB")
    print(f"last tenth against the first: {pace(clock[-part:]) / pace(clock[:part]):.3f} x the time an episode")
    growth = max(*memory, after, peak()) - memory[0]
    print(f"memory after the first tenth {memory[0]:,.0f} MiB; at its highest {growth:+,.0f} MiB")
    return 0


def pace(times: list[float]) -> float:
    """Seconds an episode."""
    return (times[-1] - times[0]) / (len(times) - 1)


def resident() -> float:
    """Resident memory of this process [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / MIB


def peak() -> float:
    """The highest that it ever was [MiB]."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    sys.exit(main())
