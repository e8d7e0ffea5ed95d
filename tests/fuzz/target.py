"""A kind of input that the program reads, and what comes of one such input: accepted, refused in a line, or else."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from random import Random

from manip_il.cli.main import LONGEST_LINE, PROGRAM, _report, load
from manip_il.cli.parsing import parse
from manip_il.errors import ManipError

LARGEST = 1024  # [MB] beyond what the process held before
Read = Callable[[Path], object]


@dataclass(frozen=True)
class Target:
    """A file of a folder, and who reads it.

    make: fills a folder with what is valid. file: of these, the one that is mutated; may be a pattern. reads: the
    program's own functions, or whole commands, one of which is tried on each input. around: open while inputs are read.
    share: inputs, relative to other targets.
    """

    name: str
    make: Callable[[Path], object]
    file: str
    mutate: Callable[[Random, bytes], bytes]
    reads: tuple[Read, ...]
    around: Callable[[Path], AbstractContextManager[object]] = lambda folder: nullcontext()
    share: float = 1.0


@dataclass(frozen=True)
class Attempt:
    """What came of one input. line: of its refusal, empty where it was accepted.

    problem: empty, or what is wrong with how it ended, a traceback behind it.
    """

    line: str
    seconds: float
    megabytes: float
    problem: str


def command(*words: str) -> None:
    """Run a command in this process, as `manip-il` does, errors as they come."""
    name = " ".join(words[:2]) if words[0] == "mcap" else words[0]
    options = parse(load(name), list(words[len(name.split()) :]))
    with contextlib.redirect_stdout(io.StringIO()):
        options.run()


def runs(*words: str) -> Read:
    """A command; `{folder}` in its words is where the files are."""
    return lambda folder: command(*(word.format(folder=folder) for word in words))


class Bench:
    """A target's valid files, to try inputs on."""

    def __init__(self, target: Target, base: Path, work: Path):
        self.target, self.base, self.work = target, base, work
        (found,) = [path for path in sorted(base.glob(target.file)) if path.is_file()][:1] or [base / target.file]
        self.file = found.relative_to(base)
        self.valid = found.read_bytes()

    def mutated(self, seed: int, number: int) -> bytes:
        """The input of a number: the same for the same seed."""
        return self.target.mutate(Random(f"{seed}/{self.target.name}/{number}"), self.valid)

    def attempt(self, data: bytes, number: int) -> Attempt:
        """Read one input, with everything else valid."""
        shutil.rmtree(self.work, ignore_errors=True)
        shutil.copytree(self.base, self.work, symlinks=True)
        (self.work / self.file).write_bytes(data)
        read = self.target.reads[number % len(self.target.reads)]
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # forget the process' peak of memory
        before, started = _memory("VmRSS"), time.perf_counter()
        line, problem = "", ""
        try:
            with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
                read(self.work)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            line, problem = _line_of(error)
        seconds, megabytes = time.perf_counter() - started, max(_memory("VmHWM") - before, 0.0)
        if megabytes > LARGEST:
            problem = problem or f"took {megabytes:.0f} MB, more than {LARGEST}"
        return Attempt(line, seconds, megabytes, problem)


@contextlib.contextmanager
def bench(target: Target, folder: Path) -> Iterator[Bench]:
    """Make the valid files and see that every way to read takes them."""
    base = folder / "base"
    base.mkdir(parents=True)
    target.make(base)
    with target.around(folder):
        made = Bench(target, base, folder / "work")
        for number in range(len(target.reads)):
            tried = made.attempt(made.valid, number)
            if tried.problem or tried.line:
                raise RuntimeError(f"{target.name}: what is valid was refused: {tried.line}\n{tried.problem}")
        yield made


def _line_of(error: BaseException) -> tuple[str, str]:
    """What the command line would print, and what is wrong with that."""
    with contextlib.redirect_stderr(io.StringIO()) as printed:
        _report(error, [])
    line = printed.getvalue().rstrip("\n").removeprefix(f"{PROGRAM}: error: ")
    trace = "".join(traceback.format_exception(error))[-6_000:]
    named = isinstance(error, OSError) and error.strerror and error.filename
    if not isinstance(error, ManipError) and not named:
        return line[:LONGEST_LINE] or "-", f"{line[:500]}\n{trace}"
    if not line or "\n" in line or len(line) > LONGEST_LINE:
        return line or "-", f"no line, more than one, or one of {len(line)} characters: {line[:500]}\n{trace}"
    return line, ""


def _memory(name: str) -> float:
    """What the process holds, or held at most [MB]."""
    found = re.search(rf"^{name}:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(found.group(1)) / 1024 if found else 0.0
