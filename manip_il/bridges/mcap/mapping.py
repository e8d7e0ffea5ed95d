"""Mapping files of an import: the topics and fields of every column. `configs/mcap/panda.yaml` explains one."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import draccus

from manip_il import checks
from manip_il.bridges.mcap.path import check_path
from manip_il.data.info import INDEX_FEATURES, NUMBERS
from manip_il.data.schema import MOST_FPS
from manip_il.errors import ManipError, UsageError

TEXT = "string"  # LeRobot's dtype for text
TASK = "task"  # key of a frame's task text


@dataclass(frozen=True)
class TopicSource:
    """A column's topic, and which message is used in a frame. tolerance: largest time from frame to message [s].

    resample: `nearest` in time (of two equally near, the earlier one), or `previous`, the last one not after the frame.
    field: paths to a message's numbers or text, joined in order. shape: that of the joined values, by default a vector.
    video: for cameras, instead of `field`; true stores lossy video, false PNG. Raises `UsageError` for options that
    contradict each other.
    """

    topic: str
    resample: Literal["nearest", "previous"]
    tolerance: float
    field: list[str] | str | None = None
    dtype: str = TEXT
    names: Any = None
    shape: tuple[int, ...] | None = None
    video: bool | None = None

    def __post_init__(self) -> None:
        checks.text("topic", self.topic, checks.LONGEST_NAME)
        if self.is_camera == bool(self.paths):
            raise UsageError("expected either field or video")
        if self.dtype not in (*NUMBERS, TEXT):
            raise UsageError(f"dtype is {self.dtype}; expected one of {', '.join((*NUMBERS, TEXT))}")
        if not 0 <= self.tolerance < math.inf:
            raise UsageError(f"tolerance is {self.tolerance}; expected seconds, 0 or more")
        for path in self.paths:
            check_path(path)
        checks.text("names", json.dumps(self.names, ensure_ascii=False), checks.LARGEST_YAML)  # info.json holds them

    @property
    def is_camera(self) -> bool:
        """Whether the column holds pictures."""
        return self.video is not None

    @property
    def paths(self) -> list[str]:
        """Paths to the values; [] for a camera."""
        return [self.field] if isinstance(self.field, str) else self.field or []

    @property
    def width(self) -> int | None:
        """Number of values per message; None if the mapping does not fix it."""
        if self.dtype == TEXT or self.shape is not None:
            return math.prod(self.shape or ())
        return len(self.names) if isinstance(self.names, list) else None


@dataclass(frozen=True)
class Mapping:
    """How topics become a dataset. task: one text for all frames, or the topic that holds the texts."""

    fps: float
    task: str | TopicSource
    features: dict[str, TopicSource]
    robot_type: str | None = None

    def __post_init__(self) -> None:
        checks.number("fps", self.fps, 1, MOST_FPS)
        checks.text("robot_type", self.robot_type or "", checks.LONGEST_NAME)
        if not self.features:
            raise UsageError("features is empty; expected at least one column")
        for key in self.features:
            checks.name("a column's name", key)  # LeRobot names folders and files after it
            if key in (*INDEX_FEATURES, TASK):
                raise UsageError(f"LeRobot fills in {key} itself; leave it out")

    @property
    def sources(self) -> dict[str, TopicSource]:
        """The topics of all columns, and of `task` if its texts come from a topic."""
        return ({TASK: self.task} if isinstance(self.task, TopicSource) else {}) | self.features


def load_mapping(path: Path) -> Mapping:
    """Read a mapping file. Raises `UsageError` naming file, column and key."""
    try:
        tree = checks.mapping("a mapping", checks.read_yaml(path, "a mapping file"))
        table = checks.mapping("features", tree.get("features"))
        features = {key: _source(f"features: {key}", value) for key, value in table.items()}
        task = tree.get("task")
        task = _source("task", task | {"dtype": TEXT}) if isinstance(task, dict) else checks.text("task", task)
        given: dict[str, Any] = {**tree, "features": features, "task": task}
        return Mapping(**given)
    except (ManipError, TypeError) as error:  # a TypeError names an unknown or missing key
        raise UsageError(f"{path}: {error}") from error


def _source(what: str, table: Any) -> TopicSource:
    try:
        return draccus.decode(TopicSource, checks.mapping("it", table))
    except (ManipError, draccus.ParsingError) as error:
        raise UsageError(f"{what}: {checks.one_line(error)}") from error
