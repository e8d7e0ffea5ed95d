"""What a disk refuses names the path, whoever was writing; other errors stay as they are."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from manip_il.data.atomic import WriteError, writing


class RustError(Exception):
    pass


FULL = "No space left on device"
REFUSALS = [
    (OSError(errno.ENOSPC, FULL), FULL, "free space"),
    (OSError(errno.EDQUOT, "x"), "quota exceeded", "free space"),
    (OSError(errno.EFBIG, "x"), "File too large", "free space"),
    (OSError(errno.EROFS, "x"), "Read-only file system", "may be written"),
    (RustError(f"Error while serializing: I/O error: {FULL} (os error 28)"), FULL, "free space"),
    (RuntimeError("Error writing bytes to file. Detail: [errno 28] No space left on device"), FULL, "free space"),
]


@pytest.mark.parametrize(("error", "why", "remedy"), REFUSALS)
def test_a_refusal_names_the_path_the_reason_and_a_remedy(error: Exception, why: str, remedy: str) -> None:
    with pytest.raises(WriteError, match=rf"^cannot write out/x: .*{why}; .*{remedy}"), writing(Path("out/x")):
        raise error


def test_a_refusal_that_names_its_file_keeps_it() -> None:
    with pytest.raises(WriteError, match="cannot write out/x/part: "), writing(Path("out/x")):
        raise OSError(errno.ENOSPC, FULL, "out/x/part")


@pytest.mark.parametrize(
    "error",
    [OSError(errno.ENOENT, "x", "in"), PermissionError(errno.EACCES, "x", "in"), ValueError("28"), KeyError(28)],
)
def test_other_errors_pass(error: Exception) -> None:
    with pytest.raises(type(error)) as raised, writing(Path("out")):
        raise error
    assert raised.value is error


def test_what_the_kernel_says_is_understood() -> None:
    """/dev/full is a disk that is always full."""
    why = f"cannot write /dev/full: {os.strerror(errno.ENOSPC)}"
    path = Path("/dev/full")
    with pytest.raises(WriteError, match=why), writing(path), path.open("wb", buffering=0) as file:
        file.write(b"x")
