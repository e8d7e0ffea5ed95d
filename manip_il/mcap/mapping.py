"""Mapping files of `manip-il mcap import`: which topics and fields make which columns of the dataset.

fps: 20
robot_type: panda
task: Put the cube on the goal.     # or a topic of texts: topic, field, resample, tolerance
features:
  observation.state:
    topic: /joint_states
    field: ["joints[name=elbow].position", "joints[name=wrist].position"]
    dtype: float32
    names: [elbow, wrist]
    resample: interpolate           # or nearest, hold
    tolerance: 0.1                  # [s]
  observation.images.front:
    topic: /camera/front
    video: false                    # false: PNG, without loss; true: an encoded video
    resample: nearest
    tolerance: 0.05

A field is a path to values in a message, or a list of paths (see `path`).
"""

from __future__ import annotations

import math
import typing
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

import yaml

from manip_il import checks
from manip_il.data.info import INDEX_FEATURES, NUMBERS
from manip_il.data.schema import MOST_FPS
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.mcap.path import parse_path

Method = Literal["nearest", "hold", "interpolate"]

TEXT = "string"  # LeRobot's dtype of text
TASK = "task"  # a frame's text, beside its columns


@dataclass(frozen=True)
class Source:
    """A topic, and how its messages are resampled to the dataset's rate. tolerance: [s]."""

    topic: str
    resample: Method
    tolerance: float

    def __post_init__(self) -> None:
        checks.text("topic", self.topic)
        if self.resample not in (methods := typing.get_args(Method)):
            raise UnknownName("resample", str(self.resample), methods)
        checks.number("tolerance", self.tolerance, 0)


@dataclass(frozen=True)
class Values(Source):
    """A column of numbers or text: the values of all paths, in order. shape: (values,) where it is None."""

    field: tuple[str, ...]
    dtype: str = TEXT
    names: Any = None
    shape: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dtype not in (*NUMBERS, TEXT):
            raise UnknownName("dtype", str(self.dtype), (*NUMBERS, TEXT))
        if self.resample == "interpolate" and not self.dtype.startswith("float"):
            raise UsageError(f"resample is interpolate, which {self.dtype} cannot be; expected nearest or hold")
        for text in self.field:
            parse_path(text)

    @property
    def width(self) -> int | None:
        """Number of values in a row; None where the mapping leaves it open."""
        if self.dtype == TEXT:
            return 1
        if self.shape is not None:
            return math.prod(self.shape)
        return len(self.names) if isinstance(self.names, list) else None


@dataclass(frozen=True)
class Camera(Source):
    """A column of pictures. video: encoded with loss, else PNG."""

    video: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.truth("video", self.video)
        if self.resample == "interpolate":
            raise UsageError("resample is interpolate, which pictures cannot be; expected nearest or hold")


@dataclass(frozen=True)
class Mapping:
    """A dataset in terms of topics. task: one text for all, or where the texts come from."""

    fps: int
    task: str | Values
    features: dict[str, Values | Camera]
    robot_type: str | None = None

    def __post_init__(self) -> None:
        checks.whole("fps", self.fps, 1, MOST_FPS)
        if not self.features:
            raise UsageError("features is empty; expected at least one column")
        for key in self.features:
            checks.name("a column's name", key)  # LeRobot names folders and files by it
            if key in (*INDEX_FEATURES, TASK):
                raise UsageError(f"LeRobot fills {key} itself; leave it out")

    @property
    def cameras(self) -> dict[str, Camera]:
        """Columns of pictures."""
        return {key: source for key, source in self.features.items() if isinstance(source, Camera)}

    @property
    def values(self) -> dict[str, Values]:
        """Columns of numbers and text, and the task's texts where they come from a topic."""
        task = {TASK: self.task} if isinstance(self.task, Values) else {}
        return task | {key: source for key, source in self.features.items() if isinstance(source, Values)}

    @property
    def topics(self) -> list[str]:
        """Every topic that is read, once."""
        return list(dict.fromkeys(one.topic for one in (*self.values.values(), *self.cameras.values())))

    def to_yaml(self) -> str:
        """Return the text of a mapping file: `load_mapping` gives an equal one."""
        return yaml.safe_dump(_plain(asdict(self)), sort_keys=False, allow_unicode=True, default_flow_style=None)


def load_mapping(path: Path) -> Mapping:
    """Read a mapping file. Raises `UsageError` naming file, column, key and value."""
    tree = checks.read_yaml(path, "a mapping file")
    place = ""
    try:
        table = _table(Mapping, tree)
        features: dict[str, Values | Camera] = {}
        for key, value in checks.mapping("features", table["features"]).items():
            place = f"features: {key}: "
            features[key] = _source(value)
        place = "task: "
        task = _source(table["task"]) if isinstance(table["task"], dict) else checks.text("task", table["task"])
        place = ""
        return Mapping(**{**table, "features": features, "task": task})
    except ManipError as error:
        raise UsageError(f"{path}: {place}{error}") from error


def _source(value: Any) -> Any:
    if isinstance(value, dict) and "video" in value:
        return Camera(**_table(Camera, value))
    table = _table(Values, value)
    paths = table["field"] if isinstance(table["field"], list) else [table["field"]]
    table["field"] = tuple(checks.text("field", path) for path in paths)
    if table.get("shape") is not None:
        table["shape"] = tuple(checks.whole("shape", size, 1, 2**31) for size in checks.array("shape", table["shape"]))
    return Values(**table)


def _table(kind: type[Any], value: Any) -> dict[str, Any]:
    """Return a mapping that has every key that a dataclass needs and none that it does not know."""
    keys = [one.name for one in fields(kind)]
    if not isinstance(value, dict):
        raise UsageError(f"got {checks.shorten(value)}; expected a mapping of {', '.join(keys)}")
    for key in value:
        if key not in keys:
            raise UnknownName("key", str(key), keys)
    for one in fields(kind):
        if one.default is MISSING and one.name not in value:
            raise UsageError(f"{one.name} is missing")
    return dict(value)


def _plain(value: Any) -> Any:
    """Return tables without the keys that are None, and lists for tuples, as YAML has them."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items() if one is not None}
    return [_plain(one) for one in value] if isinstance(value, tuple) else value
