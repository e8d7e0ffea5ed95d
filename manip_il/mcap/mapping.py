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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import draccus
import yaml

from manip_il import checks
from manip_il.data.info import INDEX_FEATURES, NUMBERS
from manip_il.data.schema import MOST_FPS
from manip_il.errors import ManipError, UsageError
from manip_il.mcap.path import parse_path

Method = Literal["nearest", "hold", "interpolate"]

TEXT = "string"  # LeRobot's dtype of text
TASK = "task"  # a frame's text, beside its columns


@dataclass(frozen=True)
class Source:
    """The topic that a column comes from, and how it is resampled to the dataset's rate. tolerance: [s].

    Numbers or text are the values of all paths in `field`, in order; shape: (values,) where it is None. Pictures have
    `video` in place of these: encoded with loss, or PNG. Raises `UsageError` for what does not fit together.
    """

    topic: str
    resample: Method
    tolerance: float
    field: list[str] | str | None = None
    dtype: str = TEXT
    names: Any = None
    shape: tuple[int, ...] | None = None
    video: bool | None = None

    def __post_init__(self) -> None:
        dtypes = (*NUMBERS, TEXT)
        for is_wrong, why in (
            (self.is_camera == bool(self.paths), "expected either field or video"),
            (self.dtype not in dtypes, f"dtype is {self.dtype}; expected one of {', '.join(dtypes)}"),
            (self.resample == "interpolate" and not self.dtype.startswith("float"), "only floats can be interpolated"),
            (len(self.topic) > checks.LONGEST_NAME, f"topic is {checks.shorten(self.topic)}; expected a topic's name"),
            (not 0 <= self.tolerance < math.inf, f"tolerance is {self.tolerance}; expected seconds, 0 or more"),
        ):
            if is_wrong:
                raise UsageError(why)
        for path in self.paths:
            parse_path(path)

    @property
    def is_camera(self) -> bool:
        """Whether the column has pictures."""
        return self.video is not None

    @property
    def paths(self) -> list[str]:
        """Paths to the values; none of a camera."""
        return [self.field] if isinstance(self.field, str) else self.field or []

    @property
    def width(self) -> int | None:
        """Number of values in a row; None where the mapping leaves it open."""
        if self.dtype == TEXT or self.shape is not None:
            return math.prod(self.shape or ())
        return len(self.names) if isinstance(self.names, list) else None


@dataclass(frozen=True)
class Mapping:
    """A dataset in terms of topics. task: one text for all, or where the texts come from."""

    fps: int
    task: str | Source
    features: dict[str, Source]
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
    def sources(self) -> dict[str, Source]:
        """All columns, and `task` if its texts come from a topic."""
        return ({TASK: self.task} if isinstance(self.task, Source) else {}) | self.features

    def to_yaml(self) -> str:
        """Return the text of a mapping file: `load_mapping` gives an equal one."""
        return yaml.safe_dump(_plain(asdict(self)), sort_keys=False, allow_unicode=True, default_flow_style=None)


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
    except (ManipError, TypeError) as error:  # the latter names an unknown or missing key
        raise UsageError(f"{path}: {error}") from error


def _source(what: str, table: Any) -> Source:
    try:
        return draccus.decode(Source, checks.mapping("it", table))
    except (ManipError, draccus.ParsingError) as error:
        raise UsageError(f"{what}: {checks.one_line(error)}") from error


def _plain(value: Any) -> Any:
    """Return tables without the keys that are None, and lists for tuples, as YAML has them."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items() if one is not None}
    return list(value) if isinstance(value, tuple) else value
