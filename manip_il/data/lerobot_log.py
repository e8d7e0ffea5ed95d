"""One line in place of LeRobot's warning of missing FFmpeg libraries."""

from __future__ import annotations

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
    logger = logging.getLogger(_LOGGER)
    if not any(isinstance(one, _OneLine) for one in logger.filters):
        logger.addFilter(_OneLine())


class _OneLine(logging.Filter):
    """Prints one line for the first warning, and drops the others."""

    def __init__(self) -> None:
        super().__init__()
        self._printed = False

    def filter(self, record: logging.LogRecord) -> bool:
        """Let every other record pass."""
        if _MARK not in record.getMessage():
            return True
        if not self._printed:
            print(NO_FFMPEG, file=sys.stderr, flush=True)  # as every other warning of ours, whatever handlers there are
        self._printed = True
        return False
