"""Settings of the video encoder, apart from the encoder itself, which takes long to import."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from manip_il import checks
from manip_il.errors import UnknownName, UsageError
from manip_il.option import option

# Default crf and preset. LeRobot's own codec and settings are those of libsvtav1; h264 takes a sixth of its time for
# the same error, which lets encoding keep up with rendering on one core.
CODECS: dict[str, tuple[float, int | str]] = {"h264": (23, "ultrafast"), "libsvtav1": (30, 12)}
_MOST_SETTING = 1_000_000  # no codec knows a larger one


@dataclass(frozen=True)
class VideoConfig:
    """Settings of the encoder, named as in LeRobot's `RGBEncoderConfig`; those of `libsvtav1` default as there.

    Raises `UnknownName` for the codec, `UsageError` for g, `ManipError` for a value of another type; `try_encoder`
    tries the rest with the codec itself.
    """

    vcodec: str = option("h264", "h264, or libsvtav1 (LeRobot's own choice, slower)")
    pix_fmt: str = option("yuv420p", "pixel format")
    g: int | None = option(2, "frames from one key frame to the next")  # what reading any single one costs
    crf: float | None = option(None, "quality, lower is better and larger; by default 23, libsvtav1 30")
    preset: int | str | None = option(None, "the codec's own; by default ultrafast, libsvtav1 12")

    def __post_init__(self) -> None:
        checks.text("vcodec", self.vcodec, checks.LONGEST_NAME)
        checks.name("pix_fmt", self.pix_fmt)
        if self.vcodec not in CODECS:
            raise UnknownName("video codec", self.vcodec, CODECS)
        if self.g is not None and checks.whole("video setting g", self.g, -_MOST_SETTING, _MOST_SETTING) < 1:
            raise UsageError(f"video setting g={self.g}; expected 1 or more frames from one key frame to the next")
        if self.crf is not None:
            checks.number("video setting crf", self.crf, -_MOST_SETTING, _MOST_SETTING)
        if isinstance(self.preset, str):
            checks.name("video setting preset", self.preset)
        elif self.preset is not None:
            checks.whole("video setting preset", self.preset, -_MOST_SETTING, _MOST_SETTING)
        crf, preset = CODECS[self.vcodec]
        object.__setattr__(self, "crf", crf if self.crf is None else self.crf)
        object.__setattr__(self, "preset", preset if self.preset is None else self.preset)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> VideoConfig:
        """Return the settings in a JSON object; raises `UnknownName` for a key that is none of them."""
        known = [field.name for field in fields(cls)]
        for key in checks.mapping("video", data):
            if key not in known:
                raise UnknownName("video setting", checks.text("a video setting", key, checks.LONGEST_NAME), known)
        return cls(**data)

    def options(self) -> dict[str, str]:
        """Return the codec's own options. One thread: a second saves no work, and of h264 it changes the bytes."""
        named = {"g": self.g, "crf": self.crf, "preset": self.preset}
        options = {name: str(value) for name, value in named.items() if value is not None}
        if self.vcodec == "libsvtav1":
            return {**options, "svtav1-params": "fast-decode=0:lp=1"}
        return {**options, "threads": "1", "bf": "0"}  # frames in their order: so that an episode can follow another
