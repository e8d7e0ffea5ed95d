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
import sys
import typing
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from manip_il import checks
from manip_il.checks import read_yaml
from manip_il.data.info import INDEX_FEATURES, NUMBERS
from manip_il.data.schema import MOST_FPS
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.mcap.path import FieldPath, parse_path

Method = Literal["nearest", "hold", "interpolate"]

TEXT = "string"  # LeRobot's dtype of text
_MOST_VALUES = 1_000_000  # in one frame of a column
_MOST_AXES = 32  # as many as an array of numpy's has

_METHODS = typing.get_args(Method)
_VALUE_KEYS = ("topic", "field", "dtype", "names", "shape", "resample", "tolerance")
_CAMERA_KEYS = ("topic", "video", "resample", "tolerance")
_TASK_KEYS = ("topic", "field", "resample", "tolerance")


@dataclass(frozen=True)
class Source:
    """A topic, and how its messages are resampled to the dataset's rate. tolerance: [s]."""

    topic: str
    resample: Method
    tolerance: float

    def __post_init__(self) -> None:
        _require("topic", self.topic, "text", isinstance(self.topic, str) and self.topic)
        if self.resample not in _METHODS:
            raise UnknownName("resample", str(self.resample), _METHODS)
        is_span = type(self.tolerance) in (int, float) and 0 <= self.tolerance <= sys.float_info.max
        _require("tolerance", self.tolerance, "seconds, 0 or more", is_span)


@dataclass(frozen=True)
class Values(Source):
    """A column of numbers or text: the values of all paths, in order. shape: (values,) where it is None."""

    field: tuple[FieldPath, ...]
    dtype: str
    names: Any = None
    shape: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dtype not in (*NUMBERS, TEXT):
            raise UnknownName("dtype", str(self.dtype), (*NUMBERS, TEXT))
        if self.resample == "interpolate" and not self.dtype.startswith("float"):
            raise UsageError(f"resample is interpolate, which {self.dtype} cannot be; expected nearest or hold")
        sizes = self.shape or (1,)
        are_sizes = len(sizes) <= _MOST_AXES and all(type(size) is int and 0 < size <= _MOST_VALUES for size in sizes)
        is_shape = are_sizes and math.prod(sizes) <= _MOST_VALUES
        _require("shape", self.shape, f"a list of whole numbers, at most {_MOST_VALUES:,} values in all", is_shape)

    @property
    def width(self) -> int | None:
        """Number of values in a row; None where the mapping leaves it open."""
        if self.shape is not None:
            return math.prod(self.shape)
        return len(self.names) if isinstance(self.names, list) else None


@dataclass(frozen=True)
class Camera(Source):
    """A column of pictures. video: encoded with loss, else PNG."""

    video: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        _require("video", self.video, "true or false", isinstance(self.video, bool))
        if self.resample == "interpolate":
            raise UsageError("resample is interpolate, which pictures cannot be; expected nearest or hold")


@dataclass(frozen=True)
class Mapping:
    """A dataset in terms of topics. task: one text for all, or where the texts come from."""

    fps: int
    robot_type: str | None
    task: str | Values
    features: dict[str, Values | Camera]

    def __post_init__(self) -> None:
        is_rate = type(self.fps) is int and 0 < self.fps <= MOST_FPS
        _require("fps", self.fps, f"a whole number above 0 and up to {MOST_FPS}", is_rate)
        is_robot = self.robot_type is None or _is_text(self.robot_type, checks.LONGEST_NAME)
        _require("robot_type", self.robot_type, "text or null", is_robot)
        is_task = isinstance(self.task, Values) or (self.task and _is_text(self.task, checks.LONGEST_TEXT))
        _require("task", self.task, "text or a topic", is_task)
        _require("features", self.features, "at least one feature", self.features)
        for key in self.features:
            try:
                checks.name("a column's name", key)  # LeRobot names folders and files by it
            except ManipError as error:
                raise UsageError(str(error)) from None

    @property
    def cameras(self) -> dict[str, Camera]:
        """Columns of pictures."""
        return {key: source for key, source in self.features.items() if isinstance(source, Camera)}

    @property
    def values(self) -> dict[str, Values]:
        """Columns of numbers and text."""
        return {key: source for key, source in self.features.items() if isinstance(source, Values)}

    @property
    def topics(self) -> list[str]:
        """Every topic that is read, once."""
        task = [self.task.topic] if isinstance(self.task, Values) else []
        return list(dict.fromkeys([*task, *(source.topic for source in self.features.values())]))

    def to_yaml(self) -> str:
        """Return the text of a mapping file: `load_mapping` gives an equal one."""
        task = self.task if isinstance(self.task, str) else _plain(self.task, _TASK_KEYS)
        features = {
            key: _plain(source, _CAMERA_KEYS if isinstance(source, Camera) else _VALUE_KEYS)
            for key, source in self.features.items()
        }
        tree = {"fps": self.fps, "robot_type": self.robot_type, "task": task, "features": features}
        return yaml.dump(tree, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


class _Dumper(yaml.SafeDumper):
    """Lists on one line, tables not."""

    def represent_sequence(
        self, tag: str, sequence: Iterable[Any], flow_style: bool | None = True
    ) -> yaml.SequenceNode:
        return super().represent_sequence(tag, sequence, flow_style=True)


def load_mapping(path: Path) -> Mapping:
    """Read a mapping file. Raises `UsageError` naming file, key, value and what was expected."""
    tree = read_yaml(path, "a mapping file")
    place = ""
    try:
        table = _table(tree, ("fps", "robot_type", "task", "features"), optional=("robot_type",))
        _require("features", table["features"], "a mapping of column names", isinstance(table["features"], dict))
        place = "task: "
        task = _load_task(table["task"])
        features: dict[str, Values | Camera] = {}
        for key, value in table["features"].items():
            place = f"features: {key}: "
            features[key] = _load_feature(key, value)
        place = ""
        return Mapping(table["fps"], table.get("robot_type"), task, features)
    except UsageError as error:
        raise UsageError(f"{path}: {place}{error}") from error


def _load_task(value: Any) -> str | Values:
    if not isinstance(value, dict):
        _require("task", value, "text, or topic, field, resample and tolerance", isinstance(value, str))
        return value
    return _load_values({**_table(value, _TASK_KEYS), "dtype": TEXT})


def _load_feature(key: Any, value: Any) -> Values | Camera:
    if key in INDEX_FEATURES:
        raise UsageError(f"LeRobot counts {key} itself; leave it out")
    if isinstance(value, dict) and "video" in value:
        return Camera(**_table(value, _CAMERA_KEYS))
    return _load_values(_table(value, _VALUE_KEYS, optional=("names", "shape")))


def _load_values(table: dict[str, Any]) -> Values:
    if (shape := table.get("shape")) is not None:
        _require("shape", shape, "a list of whole numbers", isinstance(shape, list) and shape)
        table["shape"] = tuple(shape)
    value = table["field"]
    texts = value if isinstance(value, list) else [value]
    _require("field", value, "a path or a list of paths", texts and all(isinstance(text, str) for text in texts))
    table["field"] = tuple(map(parse_path, texts))
    return Values(**table)


def _table(value: Any, keys: Iterable[str], optional: Iterable[str] = ()) -> dict[str, Any]:
    """Check that a mapping has all of the keys and no others."""
    if not isinstance(value, dict):
        raise UsageError(f"got {checks.shorten(value)}; expected a mapping of {', '.join(keys)}")
    for key in value:
        if key not in keys:
            raise UnknownName("key", str(key), keys)
    for key in keys:
        if key not in value and key not in optional:
            raise UsageError(f"{key} is missing")
    return dict(value)


def _require(what: str, value: Any, expected: str, is_right: Any) -> None:
    if not is_right:
        raise UsageError(f"{what} is {checks.shorten(value)}; expected {expected}")


def _is_text(value: Any, longest: int) -> bool:
    return isinstance(value, str) and len(value) <= longest


def _plain(source: Source, keys: Iterable[str]) -> dict[str, Any]:
    """Return a source as it is in a mapping file, without the keys that are None."""
    table = {key: getattr(source, key) for key in keys if getattr(source, key) is not None}
    if isinstance(source, Values):
        paths = [str(path) for path in source.field]
        table["field"] = paths[0] if len(paths) == 1 else paths
        if "shape" in table:
            table["shape"] = list(table["shape"])
    return table
