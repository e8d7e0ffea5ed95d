"""Output folders: what a command may begin to write to, what it may replace, and the options that are kept there."""

from __future__ import annotations

import shutil
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any

from manip_il.cli.options import options_of
from manip_il.cli.parsing import CONFIG_HEADER, dump_yaml, from_yaml
from manip_il.data.atomic import PARTIAL, exclusive, write_file
from manip_il.errors import FolderExistsError, ManipError, MismatchError, UsageError
from manip_il.option import option

CONFIG_FILE, REPORT_FILE = "config.yaml", "report.html"
# Files by which a folder of ours is known. Any LeRobot dataset has meta/info.json; only ours has both actions.
_MARKS = {CONFIG_FILE: CONFIG_HEADER, "meta/info.json": '"executed_action"', "eval.json": '"fingerprint"'}


@dataclass
class Output:
    """Folder that a command writes to."""

    output_dir: Path = option(MISSING, "folder of what is written", free=True)
    overwrite: bool = option(False, "replace what is there", free=True)

    def check(self) -> None:
        """Raise `UsageError` if a command cannot begin to write."""
        resumable, resume = hasattr(self, "resume"), getattr(self, "resume", False)
        check_output(self.output_dir, resume=resume, overwrite=self.overwrite, resumable=resumable)

    @contextmanager
    def open(self, options: Any) -> Generator[Path]:
        """Hold and prepare the folder, with the command's options in `config.yaml`; a resumed run must have the same.

        Raises `ManipError` if the folder cannot be written to.
        """
        self.check()
        folder, resume = self.output_dir, getattr(self, "resume", False)
        with ExitStack() as held:
            try:
                held.enter_context(exclusive(folder))
                prepare_output(folder, resume=resume, overwrite=self.overwrite)
            except OSError as error:
                raise ManipError(
                    f"{folder} cannot be written to ({error.strerror}); choose another --output_dir, or in a "
                    'container run as the owner of the folder: docker run --user "$(id -u):$(id -g)"'
                ) from error
            if resume:
                check_same_options(folder, options)
            save_options(folder, options)
            yield folder


@dataclass
class ResumableOutput(Output):
    """Folder of a command that can be continued."""

    resume: bool = option(False, "continue what was interrupted", free=True)


@dataclass
class OutputFile:
    """File that a command writes."""

    output: Path = option(MISSING, "the file")
    overwrite: bool = option(False, "replace an existing file")

    def check(self) -> None:
        """Raise `UsageError` if something is there that may not be replaced."""
        if self.output.is_dir() or (self.output.exists() and not self.overwrite):
            raise UsageError(f"{self.output} exists already; choose another --output, or give --overwrite=true")


def prepare_output(folder: Path, *, resume: bool = False, overwrite: bool = False) -> None:
    """Make sure that `folder` may be written to; on return it is absent or empty, unless `resume`.

    What a killed writer left of a file is removed: call it while the folder is held (`exclusive`). Raises what
    `check_output` raises.
    """
    check_output(folder, resume=resume, overwrite=overwrite, resumable=True)
    for path in folder.rglob(f".*{PARTIAL}") if resume else ():
        if path.is_file():  # a folder has a lock of its own, and is removed by the next writer
            path.unlink()
    if overwrite and folder.is_dir():
        for path in folder.iterdir():  # not the folder: it may be a mount
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def check_output(
    folder: Path, source: Path | None = None, *, resume: bool = False, overwrite: bool = False, resumable: bool = False
) -> None:
    """Raise `UsageError` if `prepare_output` would fail, or the folder overlaps what is read; nothing is changed.

    `FolderExistsError` if the folder holds something that could be continued (resumable).
    """
    if source is not None:
        inside, outside = source.resolve(), folder.resolve()
        if inside.is_relative_to(outside) or outside.is_relative_to(inside):
            raise UsageError(f"{folder} overlaps {source}; expected a folder of its own")
    if resume and overwrite:
        raise UsageError("--resume=true and --overwrite=true contradict each other; give one of them")
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file; expected a folder")
    if resume or not folder.exists() or not any(folder.iterdir()):
        return
    if overwrite:
        require_ours(folder)
    elif resumable:
        raise FolderExistsError(folder)
    else:
        raise UsageError(f"{folder} exists already; replace it with --overwrite=true")


def save_options(folder: Path, options: Any) -> None:
    """Write the resolved options to `folder/config.yaml`."""
    write_file(folder / CONFIG_FILE, dump_yaml(options).encode())


def check_same_options(folder: Path, options: Any) -> None:
    """Raise `MismatchError` naming the option unless the run in `folder` was started with the same options.

    Options with `free` in their metadata may differ, with `grows` be larger than they were. A folder that is not there
    or empty is no run yet; one without `config.yaml` is none of ours (`UsageError`).
    """
    path = folder / CONFIG_FILE
    # A run that was killed at once leaves at most half a file, under a hidden name.
    if not folder.is_dir() or all(path.name.startswith(".") for path in folder.iterdir()):
        return
    if not path.is_file():
        raise UsageError(f"{folder} holds no {CONFIG_FILE}, so there is no run to continue; choose another folder")
    before = from_yaml(path, type(options))
    for known in options_of(type(options)):
        was, now = known.value(before), known.value(options)
        has_grown = known.metadata.get("grows") and None not in (was, now) and now >= was
        if was != now and not known.metadata.get("free") and not has_grown:
            raise MismatchError(f"--{known.name}", str(path), was, "the command line", now)


def require_ours(folder: Path) -> None:
    """Raise `UsageError` if replacing `folder` would delete what this program did not make."""
    real = folder.resolve()
    if folder.is_symlink():
        raise UsageError(f"{folder} is a link to {real}; --overwrite=true deletes no links, name the folder itself")
    if any(kept.resolve().is_relative_to(real) for kept in (Path.home(), Path.cwd())) or any(real.rglob(".git")):
        raise UsageError(f"{folder} holds your home or current folder, or a git checkout; it will not be deleted")
    files = {real / name: mark.encode() for name, mark in _MARKS.items() if (real / name).is_file()}
    if not any(mark in path.read_bytes() for path, mark in files.items()):
        raise UsageError(
            f"{folder} holds something that manip-il did not make (no config.yaml, meta/info.json or eval.json of its "
            "own); choose another folder, or delete it by hand"
        )
