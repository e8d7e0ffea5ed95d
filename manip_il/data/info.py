"""Read `meta/info.json` of any LeRobot dataset."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.errors import ManipError

PICTURES = ("video", "image")
NUMBERS = (
    *("float16", "float32", "float64"),
    *("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "bool"),
)
INDEX_FEATURES = (layout.TIMESTAMP, layout.FRAME_INDEX, layout.EPISODE_INDEX, layout.INDEX, layout.TASK_INDEX)

# LeRobot's placeholders alone (`str.format` would also read attributes), and no way out of the dataset
_TEMPLATE = re.compile(r"(?!/)(?!.*\.\.)(?:[^{}]|\{(?:video_key|(?:chunk_index|file_index)(?::0\dd)?)\})+")


@dataclass(frozen=True)
class Feature:
    """One column, or one camera. shape: of one frame."""

    key: str
    dtype: str
    shape: tuple[int, ...]
    names: Any = None
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Numbers in a frame."""
        return math.prod(self.shape)

    @property
    def labels(self) -> tuple[str, ...]:
        """One name a number: those of the file, whether a list or lists by group, else `<column>.<place>`."""
        names: Any = self.names
        groups = cast(dict[str, Any], names).values() if isinstance(names, dict) else [names]
        found = [str(name) for group in groups if isinstance(group, list) for name in cast(list[Any], group)]
        return tuple(found) if len(found) == self.size else tuple(f"{self.key}.{place}" for place in range(self.size))

    @property
    def is_rgb(self) -> bool:
        """Whether it is a camera whose pictures are red, green and blue, and no depth."""
        depth = self.details.get("is_depth_map") or self.details.get("video.is_depth_map")
        return self.dtype in PICTURES and self.channels == 3 and not depth

    @property
    def picture_size(self) -> tuple[int, int]:
        """Height and width [pixels]; the names say where they stand, else they come first."""
        names = cast(list[Any], self.names) if isinstance(self.names, list) else []
        if "height" in names and "width" in names and len(names) == len(self.shape):
            return self.shape[names.index("height")], self.shape[names.index("width")]
        return (self.shape[0], self.shape[1]) if len(self.shape) > 1 else (0, 0)

    @property
    def channels(self) -> int:
        """Channels of a picture."""
        height, width = self.picture_size
        return self.size // (height * width) if height and width else 0


@dataclass(frozen=True)
class Info:
    """Content of `meta/info.json`."""

    fps: float
    features: dict[str, Feature]
    episodes: int
    frames: int
    tasks: int | None
    robot: str
    data_path: str
    video_path: str

    def of_dtype(self, *dtypes: str) -> list[Feature]:
        """Return features of these dtypes."""
        return [feature for feature in self.features.values() if feature.dtype in dtypes]


@dataclass(frozen=True)
class DatasetInfo:
    """Names and counts of a dataset. success: episodes that succeeded at some step; None if no column says so."""

    root: Path
    robot: str
    task: str
    instruction: str
    fps: float
    episodes: int
    frames: int
    success: int | None
    success_at_end: int | None


def read_info(root: Path) -> Info:
    """Read `meta/info.json` of a dataset.

    Raises `ManipError` for a folder that has none, for another version, and for a value of the wrong type or a path
    that leads out of the dataset.
    """
    path = root / layout.INFO
    if not path.exists():
        raise ManipError(f"{root} is not a LeRobot dataset: {layout.INFO} is missing")
    raw = checks.read_json(path, "a dataset's description")
    version = raw.get("codebase_version")
    if version != layout.VERSION:
        older = "; LeRobot converts datasets of v2.1" if version == "v2.1" else ""
        raise ManipError(f"{path}: codebase_version is {checks.shorten(version)}; expected {layout.VERSION!r}{older}")
    features = checks.mapping(f"{path}: features", raw.get("features"))
    return Info(
        fps=checks.number(f"{path}: fps", raw.get("fps"), 1, 1e6),
        features={key: _feature(path, key, value) for key, value in features.items()},
        episodes=_count(f"{path}: total_episodes", raw.get("total_episodes")),
        frames=_count(f"{path}: total_frames", raw.get("total_frames")),
        tasks=None if raw.get("total_tasks") is None else _count(f"{path}: total_tasks", raw["total_tasks"]),
        robot=checks.text(f"{path}: robot_type", raw.get("robot_type") or "", checks.LONGEST_NAME),
        data_path=_template(f"{path}: data_path", raw.get("data_path") or layout.DATA_PATH),
        video_path=_template(f"{path}: video_path", raw.get("video_path") or layout.VIDEO_PATH),
    )


def _feature(path: Path, key: str, value: Any) -> Feature:
    checks.name(f"{path}: a feature", key)  # folders and files are named by it
    table = checks.mapping(f"{path}: feature {key}", value)
    dtype = checks.text(f"{path}: dtype of {key}", table.get("dtype"), checks.LONGEST_NAME)
    what = f"{path}: a size in the shape of {key}"
    shape = tuple(_count(what, size) for size in checks.array(f"{path}: shape of {key}", table.get("shape")))
    details = table.get("info") or table.get("video_info") or {}
    return Feature(key, dtype, shape, table.get("names"), checks.mapping(f"{path}: info of {key}", details))


def _count(what: str, value: Any) -> int:
    return checks.whole(what, value, 0, 2**53)


def _template(what: str, value: Any) -> str:
    if not isinstance(value, str) or not _TEMPLATE.fullmatch(value):
        raise ManipError(f"{what} is {checks.shorten(value)}; expected a path with {{chunk_index}} and {{file_index}}")
    return value
