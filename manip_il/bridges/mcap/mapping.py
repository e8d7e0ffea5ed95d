"""Mapping files of an import: the topics and fields of every column.

`configs/mcap/panda.yaml` explains one.

A field is a path in a message: `pose.position.x`, `data[0]`, `scalars[:].value`,
`joints[name=elbow].position`. `[:]` selects every element of a list, `[name=elbow]` the one whose
name is elbow. A name may have any characters except dots and square brackets, the text after `=`
any except a closing bracket.
"""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import draccus
from google.protobuf.message import Message

from manip_il import checks
from manip_il.data.info import INDEX_FEATURES, NUMBERS
from manip_il.data.schema import MOST_FPS
from manip_il.errors import ManipError, UsageError, nearest

TEXT = "string"  # LeRobot's dtype for text
TASK = "task"  # key of a frame's task text
_NAME = r"[^.\[\]]+"
_SELECTOR = r"\[(:|\d+|[^=\]]+=[^\]]+)\]"
_PATH = re.compile(rf"{_NAME}(\.{_NAME}|{_SELECTOR})*")
_STEP = re.compile(rf"{_SELECTOR}|({_NAME})")


@dataclass(frozen=True)
class TopicSource:
    """A column's topic, and which message is used in a frame.

    Args:
        topic: The topic's name.
        resample: `nearest` in time (of two equally near, the earlier one), or `previous`, the last
            one not after the frame.
        tolerance: Largest time from frame to message [s].
        field: Paths to a message's numbers or text, joined in order.
        dtype: LeRobot's name for the type of the values.
        names: The values' names in `info.json`.
        shape: Shape of the joined values, by default a vector.
        video: For cameras, instead of `field`; true stores lossy video, false PNG.

    Raises:
        UsageError: Options contradict each other.
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
            raise UsageError(f"{self.topic}: expected either field or video")
        if self.dtype not in (*NUMBERS, TEXT):
            raise UsageError(
                f"{self.topic}: dtype is {self.dtype}; expected one of"
                f" {', '.join((*NUMBERS, TEXT))}"
            )
        checks.number(f"{self.topic}: tolerance", self.tolerance, 0)
        for path in self.paths:
            if not _PATH.fullmatch(path):
                expected = (
                    "names and selectors, as in joints[name=elbow].position, scalars[:].value,"
                    " data[0]"
                )
                raise UsageError(f"{self.topic}: the path {path!r} is invalid; expected {expected}")
        # info.json holds them
        checks.text("names", json.dumps(self.names, ensure_ascii=False), checks.LARGEST_YAML)

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
    """How topics become a dataset.

    Args:
        fps: The dataset's rate [frames/s].
        task: One text for all frames, or the topic that holds the texts.
        features: The columns.
        robot_type: The robot's name in the dataset.
    """

    fps: float
    task: str | TopicSource
    features: dict[str, TopicSource]
    robot_type: str | None = None

    def __post_init__(self) -> None:
        checks.number("fps", self.fps, 1, MOST_FPS)
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
    """Read a mapping file. Raises `UsageError` naming file, column or topic, and key."""
    try:
        tree = checks.mapping("a mapping", checks.read_yaml(path, "a mapping file"))
        checks.text("robot_type", tree.get("robot_type") or "", checks.LONGEST_NAME)
        task = tree.get(TASK)
        if isinstance(task, dict):
            task = draccus.decode(TopicSource, task | {"dtype": TEXT})
        else:
            checks.text(TASK, task)
        return replace(draccus.decode(Mapping, tree | {TASK: ""}), task=task)
    except (ManipError, draccus.ParsingError) as error:
        raise UsageError(f"{path}: {checks.one_line(error)}") from error


def values_at(path: str, message: Any) -> list[Any]:
    """Return the values at a path, in order; if it ends at a list, the list's elements.

    Args:
        path: The path of a field in the message.
        message: A protobuf or ROS 2 message, or parsed JSON.

    Raises:
        ManipError: if a part of `path` is missing; the message names it.
    """
    nodes = [message]
    for selector, name in _STEP.findall(path):
        nodes = [
            value
            for node in nodes
            for value in (_select(node, selector) if selector else [_field(node, name)])
        ]
    return [value for node in nodes for value in (node if _is_list(node) else [node])]


def _select(node: Any, selector: str) -> Sequence[Any]:
    if not _is_list(node):
        raise ManipError(f"[{selector}] is applied to something that is not a list")
    if selector == ":":
        return node
    key, is_named, text = selector.partition("=")
    found = (
        node[int(key) :][:1]
        if not is_named
        else [value for value in node if str(_field(value, key)) == text]
    )
    if len(found) != 1:
        raise ManipError(f"[{selector}] matches {len(found)} of {len(node)} elements; expected one")
    return found


def _field(node: Any, name: str) -> Any:
    # ROS messages have slots
    known: Any = node if isinstance(node, dict) else getattr(node, "__slots__", ())
    if isinstance(node, Message):
        known = node.DESCRIPTOR.fields_by_name
    if name not in known:
        kind = " in a list; select elements by [0], [:] or [name=...]" if _is_list(node) else ""
        raise ManipError(
            f"no field {name!r}{kind}{nearest(name, known)}; known: {', '.join(known) or 'none'}"
        )
    if isinstance(node, Message) and known[name].has_presence and not node.HasField(name):
        raise ManipError(f"{name} is not set in this message")  # protobuf would return zeros
    return node[name] if isinstance(node, dict) else getattr(node, name)


def _is_list(node: Any) -> bool:
    return isinstance(node, Sequence) and not isinstance(node, str | bytes)
