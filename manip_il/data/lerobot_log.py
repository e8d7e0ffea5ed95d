"""One line in place of LeRobot's warning of missing FFmpeg libraries."""

from __future__ import annotations

import functools
import logging
import sys

_LOGGER = "lerobot.utils.import_utils"  # logs a traceback of 90 lines where torchcodec finds no FFmpeg
_MARK = "'torchcodec' is installed but cannot be loaded"
NO_FFMPEG = (
    "manip-il: warning: FFmpeg's shared libraries are missing, so LeRobot reads videos with PyAV (slower); on Debian: "
    "apt-get install -y ffmpeg"
)


def shorten_ffmpeg_warning() -> None:
    """Replace LeRobot's warning of missing FFmpeg libraries by one line; a second call changes nothing."""
    logging.getLogger(_LOGGER).addFilter(_passes)


def _passes(record: logging.LogRecord) -> bool:
    if _MARK not in record.getMessage():
        return True
    _print_once()
    return False


@functools.cache
def _print_once() -> None:
    print(NO_FFMPEG, file=sys.stderr, flush=True)  # as every other warning of ours, whatever handlers there are
