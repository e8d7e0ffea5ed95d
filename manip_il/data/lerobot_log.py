"""What LeRobot says of itself, in our words and in one line."""

from __future__ import annotations

import logging
import sys

_LOGGER = "lerobot.utils.import_utils"  # says, with a traceback of 90 lines, that torchcodec finds no FFmpeg
_MARK = "'torchcodec' is installed but cannot be loaded"
NO_FFMPEG = (
    "manip-il: warning: FFmpeg's shared libraries are missing, so LeRobot reads videos with PyAV (slower); on Debian: "
    "apt-get install -y ffmpeg"
)


def shorten_ffmpeg_warning() -> None:
    """Have LeRobot's warning of missing FFmpeg libraries be one line, once; a second call changes nothing."""
    logger = logging.getLogger(_LOGGER)
    if not any(isinstance(one, _OneLine) for one in logger.filters):
        logger.addFilter(_OneLine())


class _OneLine(logging.Filter):
    """Says the warning in one line, and drops it from the second time on."""

    def __init__(self) -> None:
        super().__init__()
        self._said = False

    def filter(self, record: logging.LogRecord) -> bool:
        """Let everything else pass as it is."""
        if _MARK not in record.getMessage():
            return True
        if not self._said:
            print(NO_FFMPEG, file=sys.stderr, flush=True)  # as every other warning of ours, whatever handlers there are
        self._said = True
        return False
