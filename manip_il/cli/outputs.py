"""Output folders: which ones a command may write to or replace, and the options stored in them."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import MISSING, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manip_il.cli.parsing import command_line, dump_yaml, from_yaml, options_of, to_plain
from manip_il.cli.progress import say
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
from manip_il.errors import MismatchError, UsageError
from manip_il.option import keyword, option

if TYPE_CHECKING:
    from manip_il.evaluation.report import Report, Table


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
