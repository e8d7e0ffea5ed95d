"""Turn what a disk refuses (no space, read-only, a quota) into one error that names the path."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from manip_il.errors import ManipError

_ROOM = "free space there, or choose another disk"
_REMEDIES = {  # reading gives none of these
    errno.ENOSPC: _ROOM,
    errno.EDQUOT: _ROOM,
    errno.EFBIG: _ROOM,
    errno.EROFS: "choose a folder that may be written",
}
_IN_TEXT = re.compile(r"\(os error (\d+)\)|\[[Ee]rrno (\d+)\]")  # of Rust (safetensors), of Arrow and FFmpeg


class WriteError(ManipError):
    """A file or folder that cannot be written."""

    def __init__(self, path: Path, number: int):
        super().__init__(f"cannot write {path}: {os.strerror(number)}; {_REMEDIES[number]}")


@contextmanager
def writing(path: Path) -> Generator[None]:
    """Raise `WriteError` for what the disk refuses inside; it names `path` where the refusal names no file."""
    try:
        yield
    except ManipError:
        raise
    except Exception as error:  # libraries have errors of their own
        number = disk_errno(error)
        if number is None:
            raise
        named = getattr(error, "filename", None)
        raise WriteError(Path(os.fsdecode(named)) if isinstance(named, str | bytes) else path, number) from error


def disk_errno(error: BaseException) -> int | None:
    """Return the number of the disk's refusal that an error tells of; None where it tells of something else."""
    if isinstance(error, OSError):
        number = error.errno
    else:
        found = _IN_TEXT.search(str(error))
        number = int(found[1] or found[2]) if found else None
    return number if number in _REMEDIES else None
