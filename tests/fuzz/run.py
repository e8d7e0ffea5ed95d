"""`python -m tests.fuzz`: so many mutated inputs over all targets, read in processes that may hang or die."""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import queue
import shutil
import tempfile
import threading
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

from .target import Attempt, Bench, Target, bench

LONGEST = 30.0  # one input [s]: what takes longer hangs
STARTING = 900.0  # until a target's valid files are made and the first input is read [s]
CHUNK = 100  # inputs that a process is given


@dataclass
class Tally:
    """What came of a target's inputs. findings: number -> what is wrong."""

    inputs: int = 0
    accepted: int = 0
    seconds: float = 0.0
    slowest: float = 0.0
    largest: float = 0.0
    findings: dict[int, str] = field(default_factory=dict)

    def add(self, number: int, attempt: Attempt) -> None:
        self.inputs += 1
        self.accepted += attempt.accepted and not attempt.problem
        self.seconds += attempt.seconds
        self.slowest, self.largest = max(self.slowest, attempt.seconds), max(self.largest, attempt.megabytes)
        if attempt.problem:
            self.findings[number] = attempt.problem

    def row(self, name: str) -> str:
        refused = self.inputs - self.accepted - len(self.findings)
        counts = f"{self.inputs:>7,}{self.accepted:>10,}{refused:>9,}{len(self.findings):>10,}"
        return f"{name:24}{counts}{self.seconds:>10.0f}{self.slowest:>13.2f}{self.largest:>14.0f}"


def work(pipe: Connection, folder: Path) -> None:
    """Read the inputs of every task that comes, telling of each before and after; a task is a target and numbers."""
    from .table import TARGETS

    _settle(folder)
    targets = {target.name: target for target in TARGETS}
    for task in itertools.count():
        name, numbers, seed = pipe.recv()
        with bench(targets[name], folder / str(task)) as made:
            for number in numbers:
                pipe.send((number, None))
                pipe.send((number, try_input(made, seed, number)))
        shutil.rmtree(folder / str(task), ignore_errors=True)
        pipe.send(None)


def try_input(made: Bench, seed: int, number: int) -> Attempt:
    """Make an input and read it; where it cannot be made, that is the fuzz's own mistake, and no death."""
    try:
        data = made.mutated(seed, number)
    except Exception as error:
        return Attempt(False, "-", 0.0, 0.0, f"its input could not be made: {error!r}\n{traceback.format_exc()}")
    return made.attempt(data, number)


def _settle(folder: Path) -> None:
    """Make this process one that harms nobody: in a folder of its own, without a network."""
    from manip_il.sim.gl import choose_backend

    choose_backend()
    os.environ |= {"HF_HUB_OFFLINE": "1", "HOME": str(folder)}
    os.chdir(folder)


class Run:
    """All inputs of a run, dealt to processes."""

    def __init__(self, targets: Sequence[Target], inputs: int, seed: int, output: Path):
        self.seed, self.output = seed, output
        self.tallies = {target.name: Tally() for target in targets}
        self.broken: list[str] = []  # targets that could not be set up
        self._tasks: queue.SimpleQueue[tuple[Target, Sequence[int]]] = queue.SimpleQueue()
        total = sum(target.share for target in targets)
        for target in targets:
            numbers = range(max(1, round(inputs * target.share / total)))
            for start in numbers[::CHUNK]:
                self._tasks.put((target, numbers[start : start + CHUNK]))

    def run(self, processes: int) -> None:
        """Return when every input was read."""
        threads = [threading.Thread(target=self._deal) for _ in range(processes)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def _deal(self) -> None:
        """Give one process tasks, and another one what is left of a task that stopped it."""
        while True:
            with tempfile.TemporaryDirectory(prefix="manip-il-fuzz-", ignore_cleanup_errors=True) as folder:
                context = multiprocessing.get_context("spawn")
                ours, theirs = context.Pipe()
                process = context.Process(target=work, args=(theirs, Path(folder)), daemon=True)
                process.start()
                theirs.close()
                try:
                    while self._task(ours):
                        pass
                except queue.Empty:
                    return
                finally:
                    process.kill()
                    process.join()

    def _task(self, pipe: Connection) -> bool:
        """One task; whether the process can take another one."""
        target, numbers = self._tasks.get_nowait()
        pipe.send((target.name, numbers, self.seed))
        at, problem = -1, ""
        try:
            while not problem:
                if not pipe.poll(STARTING if at < 0 else LONGEST):
                    problem = f"it took more than {LONGEST:.0f} s"
                elif (message := pipe.recv()) is None:
                    return True
                elif message[1] is None:
                    at = message[0]
                else:
                    self._add(target, *message)
        except (EOFError, ConnectionResetError):
            problem = "the process died"
        if at < 0:
            self.broken.append(f"{target.name}: its valid files could not be read; {problem}")
            return False
        self._add(target, at, Attempt(False, "-", LONGEST, 0.0, problem))
        if rest := numbers[numbers.index(at) + 1 :]:
            self._tasks.put((target, rest))
        return False

    def _add(self, target: Target, number: int, attempt: Attempt) -> None:
        self.tallies[target.name].add(number, attempt)
        if attempt.problem:
            self._save(target, number, attempt)

    def _save(self, target: Target, number: int, attempt: Attempt) -> None:
        """How to see a finding again."""
        folder = self.output / f"{target.name.replace(' ', '_')}-{number}"
        folder.mkdir(parents=True, exist_ok=True)
        again = f"python -m tests.fuzz --seed={self.seed} --target='{target.name}' --number={number}"
        (folder / "problem.txt").write_text(f"{again}\n\n{attempt.problem}\n")
        print(f"finding: {target.name} {number}: {attempt.problem.partition(chr(10))[0][:300]}", flush=True)

    def report(self) -> int:
        """Print the table; the exit code."""
        head = f"{'target':24}{'inputs':>7}{'accepted':>10}{'refused':>9}{'findings':>10}{'all [s]':>10}"
        print(f"{head}{'slowest [s]':>13}{'largest [MB]':>14}")
        everything = Tally()
        for name, tally in self.tallies.items():
            print(tally.row(name))
            everything.inputs += tally.inputs
            everything.accepted += tally.accepted
            everything.seconds += tally.seconds
            everything.slowest = max(everything.slowest, tally.slowest)
            everything.largest = max(everything.largest, tally.largest)
            everything.findings |= {
                len(everything.findings) + n: text for n, text in enumerate(tally.findings.values())
            }
        print(everything.row("all"))
        for line in self.broken:
            print(line)
        if everything.findings:
            print(f"{len(everything.findings)} findings; each in a folder of {self.output}")
        return int(bool(everything.findings or self.broken))


def one(target: Target, number: int, seed: int, output: Path) -> int:
    """Try one input here, keep it, and print what came of it."""
    with tempfile.TemporaryDirectory() as name:
        _settle(folder := Path(name))
        with bench(target, folder / "files") as made:
            data = made.mutated(seed, number)
            path = output / f"{target.name.replace(' ', '_')}-{number}" / made.file.name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            print(f"{path}: {len(data):,} bytes", flush=True)
            attempt = made.attempt(data, number)
    print("accepted" if attempt.accepted else f"refused: {attempt.line}")
    print(f"{attempt.seconds:.2f} s, {attempt.megabytes:.0f} MB{attempt.problem and chr(10)}{attempt.problem}")
    return int(bool(attempt.problem))


def main() -> int:
    """Return 0 where no input ended otherwise than it should."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--target", default="", help="of this one alone; of several by the beginning of their names")
    parser.add_argument("--number", type=int, help="this one input, in this process")
    parser.add_argument("--output", type=Path, default=Path("runs/fuzz"), help="where findings are kept")
    options = parser.parse_args()
    from .table import TARGETS

    output = options.output.absolute()
    targets = [target for target in TARGETS if target.name == options.target]
    targets = targets or [target for target in TARGETS if target.name.startswith(options.target)]
    if not targets:
        parser.error(f"no such target; there are: {', '.join(target.name for target in TARGETS)}")
    if options.number is not None:
        return one(targets[0], options.number, options.seed, output)
    shutil.rmtree(output, ignore_errors=True)
    print(f"{options.inputs:,} inputs over {len(targets)} targets, seed {options.seed}", flush=True)
    run = Run(targets, options.inputs, options.seed, output)
    run.run(options.workers)
    return run.report()
