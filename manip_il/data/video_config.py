"""Settings of the video encoder, separate from the encoder, which is slow to import."""

from __future__ import annotations

from dataclasses import dataclass

from manip_il.errors import UnknownName
from manip_il.option import option

# Quality and speed. LeRobot's own default is libsvtav1, here with its settings; h264 needs a sixth of its time for the
# same error, so that encoding keeps up with rendering on one core.
CODECS: dict[str, tuple[int, int | str]] = {"h264": (23, "ultrafast"), "libsvtav1": (30, 12)}
PIXELS = "yuv420p"
GROUP = 2  # frames between key frames: the cost of reading a single frame


@dataclass(frozen=True)
class VideoConfig:
    """Settings of the encoder, named as in LeRobot's `RGBEncoderConfig`. Raises `UnknownName` for the codec."""

    vcodec: str = option("h264", "h264, or libsvtav1 (LeRobot's own choice, slower)")

    def __post_init__(self) -> None:
        if self.vcodec not in CODECS:
            raise UnknownName("video codec", self.vcodec, CODECS)

    def options(self) -> dict[str, str]:
        """Return the codec's options. One thread: a second saves no time, and changes the bytes of h264."""
        crf, preset = CODECS[self.vcodec]
        options = {"g": str(GROUP), "crf": str(crf), "preset": str(preset)}
        if self.vcodec == "libsvtav1":
            return {**options, "svtav1-params": "fast-decode=0:lp=1"}
        return {**options, "threads": "1", "bf": "0"}  # frames stay in order, so that episodes can be appended
