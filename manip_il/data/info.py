"""Read `meta/info.json` of any LeRobot dataset and check it field by field."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
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

# LeRobot's placeholders alone: `str.format` would also read attributes
_TEMPLATE = re.compile(r"(?:[^{}/]|/(?!/)|\{(?:video_key|(?:chunk_index|file_index)(?::0\dd)?)\})+")


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
    """Content of `meta/info.json`, checked."""

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


class InvalidInfo(ManipError):
    """Raised for a `meta/info.json` that cannot be used. problems: all that is wrong with it, one line each."""

    def __init__(self, root: Path, problems: list[str]):
        super().__init__(f"{root}: {layout.INFO} {problems[0]}")
        self.problems = problems


def read_info(root: Path) -> Info:
    """Read and check `meta/info.json` of a dataset. Raises `InvalidInfo`."""
    try:
        raw = read_object(root / layout.INFO)
    except FileNotFoundError:
        text = f"is missing: {root} is not a LeRobot dataset, or its recorder died before it wrote anything"
        raise InvalidInfo(root, [text]) from None
    except (OSError, ValueError) as problem:
        raise InvalidInfo(root, [f"cannot be read: {problem}"]) from problem
    version = raw.get("codebase_version")
    if version != layout.VERSION:
        older = "; LeRobot converts datasets of v2.1" if version == "v2.1" else ""
        raise InvalidInfo(root, [f"codebase_version is {version!r}; expected {layout.VERSION!r}{older}"])
    if problems := list(info_problems(raw)):
        raise InvalidInfo(root, problems)
    return Info(
        fps=float(raw["fps"]),
        features={key: _feature(key, value) for key, value in raw["features"].items()},
        episodes=raw["total_episodes"],
        frames=raw["total_frames"],
        tasks=raw.get("total_tasks"),
        robot=str(raw.get("robot_type") or ""),
        data_path=raw.get("data_path", layout.DATA_PATH),
        video_path=raw.get("video_path") or layout.VIDEO_PATH,
    )


def read_object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file. Raises `OSError`, or `ValueError` for any other content."""
    try:
        with open(checks.open_regular(path), "rb") as file:
            data = json.load(file)
    except RecursionError as problem:
        raise ValueError("it is nested too deeply") from problem
    if not isinstance(data, dict):
        raise ValueError(f"it holds {type(data).__name__}; expected an object")
    return cast(dict[str, Any], data)


def info_problems(raw: dict[str, Any]) -> Iterator[str]:
    """Yield what is wrong with the file's content, one line each: values of wrong types, paths out of the dataset."""
    fps: Any = raw.get("fps")
    if type(fps) not in (int, float) or not 1 <= fps < 1e6:
        yield f"fps is {checks.shorten(fps)}; expected a number of at least 1"
    for key in ("total_episodes", "total_frames"):
        if not _is_count(raw.get(key)):
            yield f"{key} is {checks.shorten(raw.get(key))}; expected a count"
    if not _is_count(raw.get("total_tasks", 0)):
        yield f"total_tasks is {checks.shorten(raw['total_tasks'])}; expected a count"
    robot: Any = raw.get("robot_type")
    if robot is not None and (not isinstance(robot, str) or len(robot) > checks.LONGEST_NAME):
        yield f"robot_type is {checks.shorten(robot)}; expected a name or null"
    for key in ("data_path", "video_path"):
        path: Any = raw.get(key) or layout.DATA_PATH
        if not _is_template(path):
            text = f"{key} is {checks.shorten(path)}"
            yield f"{text}; expected a path with {{chunk_index:03d}} and {{file_index:03d}}"
    features = raw.get("features")
    if not isinstance(features, dict) or not features:
        yield f"features is {checks.shorten(features)}; expected a table of columns"
        return
    for key, value in cast(dict[str, Any], features).items():
        yield from _feature_problems(key, value)


def _is_template(path: Any) -> bool:
    return isinstance(path, str) and not (".." in path or path.startswith("/")) and bool(_TEMPLATE.fullmatch(path))


def _feature_problems(key: str, value: Any) -> Iterator[str]:
    try:
        checks.name("a feature", key)  # LeRobot names folders and files by it
    except ManipError as problem:
        yield str(problem)
    if not _is_feature(value):
        yield f"feature {checks.shorten(key)} is {checks.shorten(value)}; expected dtype and shape"


def _is_feature(value: Any) -> bool:
    if not isinstance(value, dict):
        return False
    table = cast(dict[str, Any], value)
    shape: Any = table.get("shape")
    if not isinstance(table.get("dtype"), str) or not isinstance(shape, list):
        return False
    return all(_is_count(size) for size in cast(list[Any], shape))


def _feature(key: str, value: dict[str, Any]) -> Feature:
    details = value.get("info") or value.get("video_info") or {}
    details = cast(dict[str, Any], details) if isinstance(details, dict) else {}
    return Feature(key, value["dtype"], tuple(value["shape"]), value.get("names"), details)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**53
