"""What commands print and where they write.

Lines, warnings, and progress (a bar on a terminal, else a line every 5 seconds); output folders,
which ones a command may write to or replace, and the options stored in them.
"""

from __future__ import annotations

import logging
import os
import shlex
import signal
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import MISSING, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, override

from tqdm import tqdm

from manip_il.cli.parsing import command_line, dump_yaml, from_yaml, options_of, to_plain
from manip_il.data.atomic import (
    CONFIG_FILE,
    PARTIAL,
    clear,
    exclusive,
    is_our_file,
    kind_of,
    output_of,
    require_replaceable,
    write_file,
    write_json,
)
from manip_il.errors import ManipError, MismatchError, UsageError, printable
from manip_il.option import keyword, option
from manip_il.progress import Progress

if TYPE_CHECKING:
    from manip_il.evaluation.report import Report, Table

_STOPPING = b"\nstopping after the current step (press Ctrl-C again to stop at once)\n"

_quiet = False


def set_quiet(quiet: bool) -> None:
    """Switch progress off or on for this process; `say` is not affected."""
    global _quiet
    _quiet = quiet


def has_bars() -> bool:
    """Return whether to show bars: on a terminal, unless progress is switched off."""
    return sys.stderr.isatty() and not _quiet


def say(*lines: str) -> None:
    """Print lines on standard output."""
    for line in lines:
        _print(printable(line), sys.stdout)


def say_next(*words: object) -> None:
    """Print the next command to copy, quoted for a shell. words: without the program's name."""
    say(f"next: {shlex.join(['manip-il', *map(str, words)])}")


class Warnings(logging.Handler):
    """Prints what is logged as a warning on standard error, one line each."""

    @override
    def emit(self, record: logging.LogRecord) -> None:
        line = " ".join(record.getMessage().split())
        _print(f"manip-il: warning: {printable(line)}", sys.stderr)


def _print(line: str, file: TextIO) -> None:
    tqdm.write(line, file)  # above a bar, if there is one
    file.flush()


class _Log:
    """The file of a bar that is not on a terminal: every update is a line on standard error."""

    def write(self, text: str) -> None:
        if line := text.strip():
            print(line.replace("( ", "("), file=sys.stderr)  # tqdm pads rates

    def flush(self) -> None:
        sys.stderr.flush()


_PLAIN: dict[str, Any] = {
    "file": _Log(),
    "mininterval": 5.0,  # [s]
    "miniters": 1,
    "delay": 1.0,
    "unit": "",
    "bar_format": "{desc}: {n_fmt}/{total_fmt} ({rate_noinv_fmt}{postfix})",
}


class Stages(Progress):
    """Progress of work in stages, each a number of steps; use as a context manager.

    Shows a bar on a terminal, else lines like `record: 12/50 (3.40/s, success=0.92)`; nothing if
    progress is switched off. The first Ctrl-C or SIGTERM stops the work after the current step, the
    second at once.

    Args:
        kept: What is saved and can be resumed, for the message if the work is interrupted or fails.
        prepare: Prepares the output when the inputs have been checked.
    """

    def __init__(self, kept: str = "", prepare: Callable[[], None] | None = None):
        self.kept = kept
        self._prepare = prepare
        self._has_output = prepare is None
        self._stopping = False
        self._handlers = dict[int, Any]()
        self._bar: Any = None
        self._solved = 0

    def __enter__(self) -> Stages:
        self._handlers = {
            number: signal.signal(number, self._stop) for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if not self._has_output or not self.kept or isinstance(error, UsageError):
            return
        if isinstance(error, ManipError | KeyboardInterrupt):
            prefix = f"{error}; " if error.args else ""
            error.args = (f"{prefix}kept: {self.kept}; continue with --resume=true",)

    def _stop(self, *_: object) -> None:
        if self._stopping:
            raise KeyboardInterrupt
        self._stopping = True
        os.write(2, _STOPPING)  # print() is not reentrant, and a signal can interrupt one

    @override
    def started(self) -> None:
        if self._prepare is not None:
            self._prepare()
            self._has_output = True

    @override
    def start(self, description: str, total: int | None) -> None:
        self.close()
        self.check()
        how: dict[str, Any] = {"dynamic_ncols": True} if sys.stderr.isatty() else _PLAIN
        self._bar = tqdm(total=total, desc=description, disable=_quiet or total == 0, **how)
        self._bar.delay = 0.0  # the delay only keeps the constructor from writing a line
        self._solved = 0

    @override
    def close(self) -> None:
        if self._bar is not None:
            self._bar.leave = self._bar.n > 0
            self._bar.close()
            self._bar = None

    @override
    def step(self, n: int = 1, **numbers: float) -> None:
        """Count some steps of the stage.

        Args:
            n: Number of steps.
            numbers: Shown beside the bar, such as loss=0.12, until they are replaced.
        """
        if self._bar is not None:
            if numbers:
                self._bar.set_postfix(numbers, refresh=False)
            self._bar.update(n)
        self.check()

    @override
    def episode(self, episode: Any) -> None:
        self._solved += episode.success
        self.step(success=self._solved / (self._bar.n + 1) if self._bar is not None else 0.0)

    @override
    def log(self, record: dict[str, Any]) -> None:
        if record and self._bar is not None:
            shown = {name: record[name] for name in ("loss", "success", "kl") if name in record}
            self.step(record["step"] - self._bar.n, **shown)
        self.check()

    @override
    def finished(self, result: Any) -> None:
        self.close()
        learnt = f"{result.labels:,} labels, validation success {result.validation.success}"
        say(f"{result.unit} {result.number}: {learnt}, {sum(result.seconds.values()):.0f} s")
        self.check()

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if the user has asked to stop."""
        if self._stopping:
            raise KeyboardInterrupt


@contextmanager
def progress(total: int | None, description: str) -> Generator[Stages]:
    """Yield the progress of a single stage, see `Stages.start`."""
    with Stages() as stages:
        stages.start(description, total)
        yield stages


@dataclass(frozen=True, kw_only=True)
class Replacing:
    """Options of a command that can replace its output."""

    overwrite: bool = option(False, "replace existing output", free=True)


@dataclass(frozen=True, kw_only=True)
class Resumable(Replacing):
    """Options of a command that can be resumed."""

    resume: bool = option(False, "continue an interrupted run", free=True)


def output_folder(default: Any = MISSING) -> Any:
    """Return the field of a command's output folder."""
    return keyword(default, "output folder", free=True)


def output_file(default: Any = MISSING) -> Any:
    """Return the field of a command's output file."""
    return keyword(default, "output file")


@dataclass(frozen=True, kw_only=True)
class Output(Replacing):
    """The output folder of a command."""

    output_dir: Path = output_folder()

    @contextmanager
    def open(self, saved: Any = None) -> Generator[Path]:
        """Lock and prepare the folder, and write the options, or `saved`, to `config.yaml`.

        A resumed run must have the same options. Raises what `prepare_output` and
        `check_same_options` raise.
        """
        with self.lock(saved) as prepare:
            prepare()
            yield self.output_dir

    def lock(self, saved: Any = None) -> Any:
        """Return a context manager like `open`, in which a function that it yields prepares the
        folder.
        """
        kind = output_of(type(saved or self).__name__)
        return locked({self.output_dir: kind}, self, saved or self)


@dataclass(frozen=True, kw_only=True)
class ResumableOutput(Output, Resumable):
    """The output folder of a command that can be resumed."""


@dataclass(frozen=True, kw_only=True)
class OutputFile(Replacing):
    """The output file of a command."""

    output: Path = output_file()

    def check(self) -> None:
        """Raise `UsageError` if the file exists, unless it may be replaced and this program
        wrote it.
        """
        if not self.output.exists():
            return
        if not is_our_file(self.output):
            raise UsageError(
                f"{self.output} exists and does not say that manip-il wrote it; choose another name"
            )
        if not self.overwrite:
            raise UsageError(
                f"{self.output} already exists; choose another name, or give --overwrite=true"
            )


@contextmanager
def locked(kinds: Mapping[Path, str], how: Replacing, saved: Any) -> Generator[Callable[[], None]]:
    """Lock the first of a command's output folders; yield a function that prepares all of them.

    Args:
        kinds: Folder -> its kind, as `kind_of` names it. The options are written to the last.
        how: The command's options; they say whether to replace what is there, or to continue it.
        saved: The options to write.
    """
    first, *_ = kinds
    *_, home = kinds

    def prepare() -> None:
        resume = getattr(how, "resume", False)
        if resume:  # before anything is deleted
            check_same_options(home, saved)
        read = {*_inputs(to_plain(how)), *_inputs(to_plain(saved))} - kinds.keys()
        prepare_output(kinds, resume=resume, overwrite=how.overwrite, sources=read)
        save_options(home, saved)

    new = [parent for parent in first.parents if not parent.exists()]
    try:
        with exclusive(first):
            yield prepare
    finally:
        for parent in new:
            with suppress(OSError):
                parent.rmdir()  # if nothing was written


def _inputs(tree: Any) -> Iterator[Path]:
    """Yield the paths in a tree of options that exist."""
    if isinstance(tree, dict | list):
        for value in tree.values() if isinstance(tree, dict) else tree:
            yield from _inputs(value)
    elif isinstance(tree, str):
        words = (tree, *tree.split(":"))  # also `mesh:FILE:LENGTH` and `carry:FILE`
        yield from (path for word in words if word and (path := Path(word).expanduser()).exists())


def prepare_output(
    kinds: Mapping[Path, str],
    *,
    resume: bool = False,
    overwrite: bool = False,
    sources: Iterable[Path] = (),
) -> None:
    """Prepare folders for writing: on return they are absent or empty, unless `resume`.

    Args:
        kinds: Folder -> the kind of folder that may be replaced, as `kind_of` names it.
        resume: Whether to continue with what is there; then nothing of it is deleted.
        overwrite: Whether to delete what is there.
        sources: Input paths, which must not be replaced.

    Raises:
        UsageError: what `require_writable` raises.
    """
    for folder, kind in () if resume else kinds.items():  # all of them, before one is emptied
        require_writable(folder, kind, overwrite, sources)
    for folder in kinds:
        if resume:
            # files of a killed writer; `new_folder` clears partial folders
            for left in folder.rglob(f".*{PARTIAL}"):
                if left.is_file():
                    left.unlink()
        elif folder.exists():
            clear(folder)


def require_writable(
    folder: Path, kind: str, overwrite: bool, sources: Iterable[Path] = ()
) -> None:
    """Raise `UsageError` unless `folder` is absent or empty, or `overwrite` is set and it is a
    folder of this kind.

    Args:
        folder: The output folder.
        kind: Kind of folder that may be replaced, as `kind_of` names it.
        overwrite: Whether it may be replaced.
        sources: Input paths, which must not be replaced.
    """
    if overwrite and kind_of(folder) != "":
        for source in sources:
            if source.resolve().is_relative_to(folder.resolve()):
                raise UsageError(f"{folder} overlaps {source}; expected a separate folder")
    require_replaceable(folder, kind if overwrite else "")


def about(options: Any) -> dict[str, Any]:
    """Return the fields of a `Report` that say how it was made: the command line and the
    resolved options.
    """
    return {"command": command_line(), "config": to_plain(options)}


def publish(
    path: Path,
    content: Mapping[str, Any],
    tables: Iterable[Table],
    *lines: str,
    page: Report | None = None,
    options: Any = None,
) -> None:
    """Write a result as JSON, with its report beside it, and print what was found.

    Args:
        path: The JSON file.
        content: The result, as plain JSON values.
        tables: Tables to print.
        lines: Lines to print below the tables; the names of the written files follow them.
        page: The report, if there is one.
        options: The command's options, for the report; see `about`.
    """
    written = [f"result: {path}"]
    write_json(path, content)
    if page is not None:
        written.append(f"report: {replace(page, **about(options)).write(path.parent)}")
    for table in tables:
        table.print()
    say(*lines, *written)


def save_options(folder: Path, options: Any) -> None:
    """Write the resolved options to `folder/config.yaml`."""
    write_file(folder / CONFIG_FILE, dump_yaml(options).encode())


def check_same_options(folder: Path, options: Any) -> None:
    """Raise `MismatchError`, which names the option, unless the run in `folder` was started with
    the same options.

    Options with `free` in their metadata may differ, those with `grows` may increase. A missing or
    empty folder is accepted; any other one without `config.yaml` is a `UsageError`.
    """
    path = folder / CONFIG_FILE
    # A run that was killed at the start leaves at most a partial file with a hidden name.
    if not folder.is_dir() or all(path.name.startswith(".") for path in folder.iterdir()):
        return
    before = from_yaml(path, type(options))
    for known in options_of(type(options)):
        was, now = known.value(before), known.value(options)
        has_grown = known.metadata.get("grows") and None not in (was, now) and now >= was
        if was != now and not known.metadata.get("free") and not has_grown:
            what = (
                f"--{known.name}{', which may only grow,' if known.metadata.get('grows') else ''}"
            )
            raise MismatchError(what, str(path), was, "the command line", now)
