"""Settings of the video encoder, separate from the encoder, which is slow to import."""

from dataclasses import dataclass

from manip_il.errors import UnknownName
from manip_il.option import option

# Codec -> default crf and preset. LeRobot's own default is libsvtav1. h264 takes a sixth of its
# time for equal error, so that encoding keeps up with rendering on one core.
CODECS: dict[str, tuple[float, int | str]] = {"h264": (23, "ultrafast"), "libsvtav1": (30, 12)}


@dataclass(frozen=True)
class VideoConfig:
    """Settings of the encoder, named as in LeRobot's `RGBEncoderConfig`, with the same defaults for
    `libsvtav1`.

    Raises `UnknownName` for an unknown codec; the encoder checks the other settings.
    """

    vcodec: str = option("h264", "h264, or libsvtav1 (LeRobot's own choice, slower)")
    pix_fmt: str = option("yuv420p", "pixel format")
    # to read one frame, at most this many are decoded
    g: int | None = option(2, "frames between key frames")
    crf: float | None = option(
        None, "quality: lower is better, files larger; by default 23 (h264) or 30 (libsvtav1)"
    )
    preset: int | str | None = option(
        None, "the codec's speed preset; by default ultrafast (h264) or 12 (libsvtav1)"
    )

    def __post_init__(self) -> None:
        if self.vcodec not in CODECS:
            raise UnknownName("video codec", self.vcodec, CODECS)
        crf, preset = CODECS[self.vcodec]
        object.__setattr__(self, "crf", crf if self.crf is None else self.crf)
        object.__setattr__(self, "preset", preset if self.preset is None else self.preset)

    def options(self) -> dict[str, str]:
        """Return the codec's options, among them one thread: two would save no time, but change
        the bytes of h264.
        """
        named = {"g": self.g, "crf": self.crf, "preset": self.preset}
        options = {name: str(value) for name, value in named.items() if value is not None}
        if self.vcodec == "libsvtav1":
            return {**options, "svtav1-params": "fast-decode=0:lp=1"}
        # frames stay in order, so that episodes can be appended
        return {**options, "threads": "1", "bf": "0"}
