"""`meta/info.json` of any LeRobot dataset, checked field by field: everything else is read by what it says."""

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
from manip_il.data.schema import LONGEST_SIDE
from manip_il.doctor.finding import Finding, error
from manip_il.errors import ManipError

PICTURES = ("video", "image")
NUMBERS = (
    *("float16", "float32", "float64"),
    *("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "bool"),
)
INDEX_FEATURES = (layout.TIMESTAMP, layout.FRAME_INDEX, layout.EPISODE_INDEX, layout.INDEX, layout.TASK_INDEX)

LARGEST_META = 16 * 1024 * 1024  # of a JSON file in `meta` [bytes]
_LONGEST_PATH = 1_000  # [characters]
_MOST_AXES = 32  # as many as an array of numpy's has

# the placeholders that LeRobot fills in, and nothing that `str.format` could be made to do beside that
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
    def picture_size(self) -> tuple[int, int]:
        """Height and width [pixels]; the names say where they stand, else they come first."""
        names = cast(list[Any], self.names) if isinstance(self.names, list) else []
        if "height" in names and "width" in names and len(names) == len(self.shape):
            return self.shape[names.index("height")], self.shape[names.index("width")]
        return (self.shape[0], self.shape[1]) if len(self.shape) > 1 else (0, 0)

    @property
    def channels(self) -> int:
        """Of a picture."""
        height, width = self.picture_size
        return self.size // (height * width) if height and width else 0


@dataclass(frozen=True)
class Info:
    """What `meta/info.json` says."""

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


def read_info(root: Path) -> tuple[Info | None, list[Finding]]:
    """Return the file's content, or None where nothing else can be read by it; and what is wrong with it."""
    try:
        raw = read_object(root / layout.INFO)
    except FileNotFoundError:
        text = f"is missing: {root} is not a LeRobot dataset, or its recorder died before it wrote anything"
        return None, [error(layout.INFO, text)]
    except (OSError, ValueError, RecursionError) as problem:
        return None, [error(layout.INFO, f"cannot be read: {problem}")]
    version = raw.get("codebase_version")
    if version != layout.VERSION:
        older = "; LeRobot converts datasets of v2.1" if version == "v2.1" else ""
        return None, [error(layout.INFO, f"codebase_version is {version!r}; expected {layout.VERSION!r}{older}")]
    findings = [error(layout.INFO, text) for text in info_problems(raw)]
    if findings:
        return None, findings
    info = Info(
        fps=float(raw["fps"]),
        features={key: _feature(key, value) for key, value in raw["features"].items()},
        episodes=raw["total_episodes"],
        frames=raw["total_frames"],
        tasks=raw.get("total_tasks"),
        robot=str(raw.get("robot_type") or ""),
        data_path=raw.get("data_path", layout.DATA_PATH),
        video_path=raw.get("video_path") or layout.VIDEO_PATH,
    )
    return info, list(_feature_findings(info))


def read_object(path: Path) -> dict[str, Any]:
    """Return a JSON object. Raises `OSError`, or `ValueError` for anything else."""
    with path.open("rb") as file:
        content = file.read(LARGEST_META + 1)
    if len(content) > LARGEST_META:
        raise ValueError(f"it has more than {LARGEST_META:,} bytes")
    try:
        data = json.loads(content)
    except RecursionError as problem:
        raise ValueError("it is nested too deeply") from problem
    if not isinstance(data, dict):
        raise ValueError(f"it holds {type(data).__name__}; expected an object")
    return cast(dict[str, Any], data)


def info_problems(raw: dict[str, Any]) -> Iterator[str]:
    """What of the file's content no reader may rely on, one line each: values of other types, paths that lead out."""
    fps: Any = raw.get("fps")
    if not _is_number(fps) or not 1 <= fps < 1e6:
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
    if not isinstance(path, str) or len(path) > _LONGEST_PATH or ".." in path or path.startswith("/"):
        return False
    return _TEMPLATE.fullmatch(path) is not None


def _feature_problems(key: str, value: Any) -> Iterator[str]:
    try:
        checks.name("a feature", key)  # LeRobot names folders and files by it
    except ManipError as problem:
        yield str(problem)
    if not _is_feature(value):
        yield f"feature {checks.shorten(key)} is {checks.shorten(value)}; expected dtype and shape"
    elif value["dtype"] in PICTURES and max(value["shape"], default=0) > LONGEST_SIDE:
        text = f"feature {checks.shorten(key)} has shape {checks.shorten(value['shape'])}"
        yield f"{text}; expected at most {LONGEST_SIDE:,} pixels a side"


def _is_feature(value: Any) -> bool:
    if not isinstance(value, dict):
        return False
    table = cast(dict[str, Any], value)
    shape = table.get("shape")
    if (
        not isinstance(table.get("dtype"), str)
        or not isinstance(shape, list)
        or len(cast(list[Any], shape)) > _MOST_AXES
    ):
        return False
    return all(_is_count(size) for size in cast(list[Any], shape)) and math.prod(cast(list[int], shape)) < 2**31


def _feature(key: str, value: dict[str, Any]) -> Feature:
    details = value.get("info") or value.get("video_info") or {}
    details = cast(dict[str, Any], details) if isinstance(details, dict) else {}
    return Feature(key, value["dtype"], tuple(value["shape"]), value.get("names"), details)


def _feature_findings(info: Info) -> Iterator[Finding]:
    if missing := [key for key in INDEX_FEATURES if key not in info.features]:
        yield error(layout.INFO, f"features lack {', '.join(missing)}, which every LeRobot dataset has")
    for feature in info.features.values():
        count = _name_count(feature.names)
        wanted = len(feature.shape) if feature.dtype in PICTURES else feature.size
        fits = count in (None, wanted) or (len(feature.shape) > 1 and count == len(feature.shape))
        if not fits:
            shape = list(feature.shape)
            yield error(f"{layout.INFO}: {feature.key}", f"{count} names for shape {shape}; expected {wanted}")


def _name_count(names: Any) -> int | None:
    """How many names; None where there are none, or in a form that cannot be counted."""
    if isinstance(names, list):
        return len(cast(list[Any], names))
    if isinstance(names, dict) and names:
        values = list(cast(dict[str, Any], names).values())
        lists = [cast(list[Any], value) for value in values if isinstance(value, list)]
        return sum(map(len, lists)) if len(lists) == len(values) else len(values) if not lists else None
    return None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**53
