"""Output folders: which ones a command may write to or replace, and the options stored in them."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manip_il.cli.options import command_line, options_of, to_plain
from manip_il.cli.parsing import dump_yaml, from_yaml
from manip_il.cli.progress import say
from manip_il.data.atomic import clear, exclusive, write_file, write_json
from manip_il.data.ownership import (
    CONFIG_FILE,
    PARTIAL,
    is_our_file,
    kind_of,
    output_of,
    require_replaceable,
)
from manip_il.errors import MismatchError, UsageError
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.evaluation.report import Report
    from manip_il.evaluation.tables import Table

REPORT_FILE = "report.html"


@dataclass(frozen=True, kw_only=True)
class Replacing:
    """Options of a command that can replace its output."""

    overwrite: bool = option(False, "replace existing output", free=True)


@dataclass(frozen=True, kw_only=True)
class Resumable(Replacing):
    """Options of a command that can be resumed."""

    resume: bool = option(False, "continue an interrupted run", free=True)


@dataclass(frozen=True)
class Output(Replacing):
    """The output folder of a command."""

    output_dir: Path = option(MISSING, "output folder", free=True)

    @contextmanager
    def open(self, options: Any, *sources: Path) -> Generator[Path]:
        """Lock and prepare the folder, and write the options to `config.yaml`; a resumed run must have the same ones.

        Raises what `prepare_output` and `check_same_options` raise.
        """
        folder, resume = self.output_dir, getattr(self, "resume", False)
        with exclusive(folder):
            if resume:  # before anything is deleted
                check_same_options(folder, options)
            sources = (*_inputs(options), *sources)
            kind = kind_of_output(options)
            prepare_output(folder, kind, resume=resume, overwrite=self.overwrite, sources=sources)
            save_options(folder, options)
            yield folder


def kind_of_output(options: Any) -> str:
    """Return the kind of folder into which a command with these options writes."""
    return output_of(type(options).__name__)


def _inputs(options: Any) -> list[Path]:
    """Return the paths in a command's options, except its output folder."""
    found = list[Path]()
    for one in options_of(type(options)):
        value = one.value(options)
        if isinstance(value, dict):  # `--policy.path` and `--policy.states` of a fit
            value = [value[name] for name in ("path", "states") if isinstance(value.get(name), str)]
        if one.name != "output_dir":
            items = value if isinstance(value, list) else [value]
            found += [Path(item).expanduser() for item in items if isinstance(item, Path) or one.is_open]
            words = [word for item in items if isinstance(item, str) for word in (item, *item.split(":"))]
            found += [Path(word) for word in words if word and Path(word).is_file()]  # of a task, a suite, a mesh, ...
    return found


@dataclass(frozen=True)
class ResumableOutput(Output, Resumable):
    """The output folder of a command that can be resumed."""


@dataclass(frozen=True)
class OutputFile(Replacing):
    """The output file of a command."""

    output: Path = option(MISSING, "output file")

    def check(self) -> None:
        """Raise `UsageError` if the file exists, unless it may be replaced and this program wrote it."""
        if not self.output.exists():
            return
        if not is_our_file(self.output):
            raise UsageError(f"{self.output} exists and does not say that manip-il wrote it; choose another name")
        if not self.overwrite:
            raise UsageError(f"{self.output} already exists; choose another name, or give --overwrite=true")


def prepare_output(
    folder: Path, kind: str, *, resume: bool = False, overwrite: bool = False, sources: Sequence[Path] = ()
) -> None:
    """Prepare `folder` for writing: on return it is absent or empty, unless `resume`.

    Args:
        folder: The output folder.
        kind: Kind of folder that may be replaced, as `kind_of` names it.
        resume: Whether to continue with what is there.
        overwrite: Whether to delete what is there.
        sources: Input paths, which must not be replaced.

    Raises what `require_writable` raises.
    """
    if resume and overwrite:
        raise UsageError("--resume=true and --overwrite=true contradict each other; give one of them")
    if resume:
        for left in folder.rglob(f".*{PARTIAL}"):  # files of a killed writer; `new_folder` clears partial folders
            if left.is_file():
                left.unlink()
    elif folder.exists():
        require_writable(folder, kind, overwrite, sources)
        clear(folder)


def require_writable(folder: Path, kind: str, overwrite: bool, sources: Sequence[Path] = ()) -> None:
    """Raise `UsageError` unless `folder` is absent or empty, or `overwrite` is set and it is a folder of this kind.

    Args:
        folder: The output folder.
        kind: Kind of folder that may be replaced, as `kind_of` names it.
        overwrite: Whether it may be replaced.
        sources: Input paths, which must not be replaced.
    """
    if overwrite and kind_of(folder) != "":
        overlapping = [source for source in sources if source.resolve().is_relative_to(folder.resolve())]
        if overlapping:
            raise UsageError(f"{folder} overlaps {overlapping[0]}; expected a separate folder")
    require_replaceable(folder, kind if overwrite else "")


def write_page(page: Report, path: Path, options: Any) -> None:
    """Write a report, with the command line and the resolved options that made it."""
    replace(page, command=command_line(), config=to_plain(options)).write(path)


def publish(
    path: Path,
    content: Mapping[str, Any],
    tables: Iterable[Table],
    *lines: str,
    page: Report | None = None,
    options: Any = None,
) -> None:
    """Write a result as JSON, and its report beside it if there is one; print its tables, lines and files.

    options: as for `write_page`.
    """
    from manip_il.evaluation.tables import print_table

    written = [f"result: {path}"]
    write_json(path, content)
    if page is not None:
        write_page(page, path.with_name(REPORT_FILE), options)
        written.append(f"report: {path.with_name(REPORT_FILE)}")
    for table in tables:
        print_table(table)
    say(*lines, *written)


def save_options(folder: Path, options: Any) -> None:
    """Write the resolved options to `folder/config.yaml`."""
    write_file(folder / CONFIG_FILE, dump_yaml(options).encode())


def check_same_options(folder: Path, options: Any) -> None:
    """Raise `MismatchError`, which names the option, unless the run in `folder` was started with the same options.

    Options with `free` in their metadata may differ, those with `grows` may increase. A missing or empty folder is
    accepted; any other one without `config.yaml` is a `UsageError`.
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
            what = f"--{known.name}{', which may only grow,' if known.metadata.get('grows') else ''}"
            raise MismatchError(what, str(path), was, "the command line", now)
