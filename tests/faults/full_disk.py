"""A disk that is full after so many bytes, a mounted one where this is root, else a limit on every file; and errors."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Disk:
    """folder: where it is. is_real: whether the kernel says that the disk is full, not that a file is too large."""

    folder: Path
    is_real: bool

    def grow(self) -> None:
        """Have room again."""
        if self.is_real:
            subprocess.run(["mount", "-o", "remount,size=64m", self.folder], check=True)
        else:
            _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))


@contextlib.contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Disk]:
    """A disk of so many bytes at `folder`, for this process and those that it starts."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder]
    if os.getuid() == 0 and subprocess.run(mount, capture_output=True, check=False).returncode == 0:
        try:
            yield Disk(folder, True)
        finally:
            subprocess.run(["umount", "--lazy", folder], check=True)
        return
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield Disk(folder, False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def the_error(printed: str) -> str:
    """The error among what a command printed; there is no more than that one line of it."""
    assert "Traceback" not in printed
    (line,) = [line for line in printed.splitlines() if line.startswith("manip-il: error:")]
    return line
