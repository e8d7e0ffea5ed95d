"""Write files and folders atomically, and name the path if a disk is full or read-only.

Some files have one JSON record per line; a kill truncates at most the last line.

A folder's content tells whether this program made it, and of which kind it is. Everything that
replaces, empties or adds to a folder checks this here first.
"""

import contextlib
import ctypes
import errno
import fcntl
import json
import math
import os
import re
import shutil
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.errors import FolderExistsError, ManipError, UsageError

PARTIAL = ".partial"  # suffix of unfinished files and folders
UNFINISHED_MARK = ".manip_il_unfinished"  # file in the folder around one that is being written
# options of a command, and how their first line begins
CONFIG_FILE, CONFIG_HEADER = "config.yaml", "# manip-il"
DATASET = "a dataset"
EPISODES = "journals"
POLICY = "a policy"
CHECKPOINT = "a checkpoint"
UNFINISHED = "an unfinished folder"

_OPTIONS = re.compile(rf"{CONFIG_HEADER} .*\((\w+)\)\n".encode())


def output_of(options: str) -> str:
    """Return the kind of the folder that holds a command's options.

    Args:
        options: Name of the options' class.
    """
    command = options.removesuffix("Options").lower()
    return EPISODES if command == "record" else f"the output of manip-il {command}"


_MARKS = (  # kind, file and a text in it that only we write
    (UNFINISHED, UNFINISHED_MARK, b""),
    (DATASET, "meta/manip_il.json", b'"fingerprint"'),
    (DATASET, "meta/info.json", b'"executed_action"'),  # imported from the MCAP files of a dataset
    (EPISODES, "recording.json", b'"only_successes"'),
    (POLICY, "manip_il.json", b'"action_meaning"'),
    # perhaps a copy of somebody's policy, in a run of ours
    (CHECKPOINT, "pretrained_model/config.json", b'"type"'),
    # a run from Python, as in the next two
    (output_of("Dagger"), "settings.json", b'"label_budget"'),
    (output_of("Train"), "metrics.jsonl", b'"samples_per_s"'),
    (output_of("Eval"), "eval.json", b'"fingerprint"'),
)


def kind_of(folder: Path) -> str | None:
    """Return the kind of a folder that this program made.

    "" if there is none yet, None if somebody else made it.

    A folder that holds at most unfinished files counts as none.
    """
    if not folder.is_dir():
        return None if folder.exists(follow_symlinks=False) else ""
    if all(path.name.startswith(".") and path.name.endswith(PARTIAL) for path in folder.iterdir()):
        return ""
    options = folder / CONFIG_FILE
    if options.is_file() and (made_by := _OPTIONS.match(checks.read_bytes(options, "options"))):
        return output_of(made_by[1].decode())
    for kind, name, mark in _MARKS:
        if (folder / name).is_file() and mark in checks.read_bytes(folder / name, kind):
            return kind
    return None


def is_our_file(path: Path) -> bool:
    """Return whether a file names this program, as each single file that a command writes does."""
    return (
        path.is_file() and re.search(rb"manip[-_]il", checks.read_bytes(path, "a file")) is not None
    )


def require_ours(folder: Path, kind: str) -> None:
    """Raise `UsageError` unless there is nothing at `folder`, or a folder of this kind."""
    there = kind_of(folder)
    if there not in ("", kind):
        found = there or "files that manip-il did not make"
        raise UsageError(
            f"{folder} holds {found}; expected {kind} or an empty folder: choose another folder"
        )


def require_replaceable(folder: Path, kind: str = "") -> None:
    """Raise `UsageError` unless there is nothing at `folder`, or a folder of this kind and no link
    to one.

    Without a kind, raises `FolderExistsError` for anything that is there.
    """
    if kind_of(folder) == "":
        return
    if not kind:
        raise FolderExistsError(folder)
    if folder.is_symlink():
        raise UsageError(
            f"{folder} is a link, which is not followed to replace files; give {folder.resolve()}"
        )
    require_ours(folder, kind)


_WRITE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)  # never raised by reading


@contextlib.contextmanager
def writing(path: Path) -> Generator[None]:
    """Raise `ManipError` if the disk is full or read-only.

    It names the file that failed, or `path` if unknown.
    """
    try:
        yield
    except Exception as error:
        # errors of Arrow and FFmpeg are OSErrors, too; those of safetensors only name the number
        named = re.search(r"os error (\d+)", str(error))
        number = getattr(error, "errno", None) or (int(named[1]) if named else None)
        if number not in _WRITE_ERRORS:
            raise
        place = getattr(error, "filename", None) or path
        raise ManipError(f"cannot write {place}: {os.strerror(number)}") from error


@contextlib.contextmanager
def new_folder(root: Path, *, replaces: str = "") -> Generator[Path]:
    """Yield an empty folder beside `root` to write into.

    At the end, sync it to disk and rename it to `root`.

    It is in `.NAME.partial`, which an exception removes, and which the next writer empties if a
    killed process left it.

    Args:
        root: The new folder. It must not exist or be empty, at the beginning and at the end.
        replaces: Kind of folder whose place it may take instead, as `kind_of` names it.

    Raises:
        FolderExistsError: if `root` is not empty and `replaces` is empty.
        UsageError: if `root` is another kind of folder, or a link.
        ManipError: if the disk is full or read-only, or if another process writes the same folder.
    """
    root = root.absolute()
    require_replaceable(root, replaces)
    partial = root.with_name(f".{root.name}{PARTIAL}")
    if partial.is_symlink():  # a planted link: its target must not be cleared
        partial.unlink()
    new, mark = partial / root.name, partial / UNFINISHED_MARK
    with writing(root), exclusive(partial) as handle:
        require_replaceable(partial, UNFINISHED)
        mark.touch()
        clear(partial, keep=mark)
        new.mkdir()
        try:
            yield new
            _libc("syncfs", handle)  # one call for all files
            require_replaceable(root, replaces)
            if replaces and root.exists():
                # AT_FDCWD and RENAME_EXCHANGE: `root` exists at every moment
                here, exchange = -100, 2
                _libc("renameat2", here, os.fsencode(new), here, os.fsencode(root), exchange)
            else:
                new.rename(root)
            sync(root.parent)
        finally:
            shutil.rmtree(new, ignore_errors=True)
            mark.unlink(missing_ok=True)  # last, so that a kill leaves nothing that is not marked


@contextlib.contextmanager
def exclusive(folder: Path) -> Generator[int]:
    """Lock `folder` for this process, creating it if it does not exist; yield its file descriptor.

    The kernel releases the locks of a killed process. Raises `ManipError` if another process holds
    the lock.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            text = (
                f"{folder} is in use by another process; wait until that is done, or choose another"
                " folder"
            )
            raise ManipError(text) from error
        except OSError:  # a cluster's file system may not support locks
            pass
        try:
            yield handle
        finally:
            with contextlib.suppress(OSError):
                folder.rmdir()  # if nothing was written
    finally:
        os.close(handle)


def clear(folder: Path, keep: Path | None = None) -> None:
    """Delete everything in a folder except `keep`, but not the folder itself, which may be
    locked or a mount point.
    """
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path != keep:
            path.unlink()


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write `content` to `path` as JSON, atomically as `write_file` does."""
    write_file(
        path, (json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode()
    )


def write_file(path: Path, data: bytes) -> None:
    """Write `data` to `path` atomically, creating its folder.

    Raises `ManipError` if the disk is full or read-only.
    """
    partial = path.with_name(f".{path.name}.{os.urandom(6).hex()}{PARTIAL}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with partial.open("xb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
        sync(path.parent)  # otherwise a power cut may undo the rename


def sync(path: Path) -> None:
    """Flush a file's content, or a folder's list of names, to disk."""
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _libc(name: str, *arguments: int | bytes) -> None:
    """Call a function of Linux's C library that Python does not wrap."""
    if getattr(ctypes.CDLL(None, use_errno=True), name)(*arguments):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


Record = Mapping[str, Any]


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return every record, except a truncated last line; [] if there is no file.

    Non-finite numbers are None. Raises `ManipError` naming any other line that is not a JSON
    object.
    """
    lines = checks.read_bytes(path, "JSON lines").splitlines(keepends=True) if path.exists() else []
    whole = [line for line in lines if line.endswith(b"\n")]
    return [
        checks.mapping(name := f"{path}, line {number}", checks.parse_json(name, line))
        for number, line in enumerate(whole, 1)
    ]


def append_line(path: Path, record: Record) -> None:
    """Append a record, replacing a truncated last line.

    Non-finite numbers at its top level become null.
    """
    line = json.dumps(_finite(record), allow_nan=False, default=_plain).encode() + b"\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    with writing(path), open(path, "ab+", opener=checks.without_link) as file:
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)
        file.write(line)
        file.flush()  # inside `writing`, which reports a full disk


def _finite(record: Record) -> dict[str, Any]:
    return {
        key: None if isinstance(one, float) and not math.isfinite(one) else one
        for key, one in record.items()
    }


def _plain(value: Any) -> Any:
    """Return a numpy scalar, an array or a path as a JSON value."""
    return value.tolist() if hasattr(value, "tolist") else str(value)
