"""Paths to values inside a decoded message: `joints[name=elbow].position`, `scalars[:].value`, `pose.position.x`."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from google.protobuf.message import Message

from manip_il.errors import ManipError, UsageError, nearest

_WORD = r"[^\W\d]\w*"
_QUOTED = r'"(?:[^"\\]|\\.)*"'
_NAME = re.compile(rf"\.?(?:(?P<word>{_WORD})|(?P<quoted>{_QUOTED}))")
_SELECTOR = re.compile(
    rf"\[(?:(?P<all>:)|(?P<index>\d+)|(?P<key>{_WORD})=(?:(?P<quoted>{_QUOTED})|(?P<text>[^\]\"][^\]]*)))\]"
)


@dataclass(frozen=True)
class Field:
    """`.name`; `."any text"` where it is no plain word."""

    name: str


@dataclass(frozen=True)
class Index:
    """`[3]`: one element of a list, from 0."""

    index: int


@dataclass(frozen=True)
class All:
    """`[:]`: every element of a list, in order."""


@dataclass(frozen=True)
class Where:
    """`[name=elbow]`: the one element whose field has this text; `[name="a]b"]` where a bracket is in it."""

    key: str
    text: str


Step = Field | Index | All | Where


@dataclass(frozen=True)
class FieldPath:
    """A parsed path; `str` gives its text."""

    steps: tuple[Step, ...]

    def __str__(self) -> str:
        return "".join(map(_text, self.steps)).removeprefix(".")

    def values(self, message: Any) -> list[Any]:
        """What the path leads to: one value, or several in order. A list at its end stands for its elements.

        Raises `ManipError` naming the step that leads nowhere, with the nearest name that does.
        """
        nodes = [message]
        for number, step in enumerate(self.steps):
            try:
                nodes = [found for node in nodes for found in _take(node, step)]
            except LookupError as error:
                raise ManipError(f"{FieldPath(self.steps[: number + 1])}: {error.args[0]}") from None
        return [value for node in nodes for value in (node if _is_list(node) else [node])]


def parse_path(text: str) -> FieldPath:
    """Parse a path. Raises `UsageError` that shows where it goes wrong."""
    steps: list[Step] = []
    place = 0
    while place < len(text) or not steps:
        match = (_SELECTOR if steps and text[place] == "[" else _NAME).match(text, place)
        if match is None or match.group().startswith(".") != bool(steps and match.re is _NAME):
            raise UsageError(
                f"the path {text!r} is invalid at character {place + 1}; expected names and selectors, "
                "as in joints[name=elbow].position, scalars[:].value, data[0]"
            )
        steps.append(_step(match))
        place = match.end()
    return FieldPath(tuple(steps))


def _step(match: re.Match[str]) -> Step:
    found = match.groupdict()
    if match.re is _NAME:
        return Field(found["word"] or _unquoted(found["quoted"]))
    if found["all"]:
        return All()
    if found["index"]:
        return Index(int(found["index"]))
    return Where(found["key"], found["text"] or _unquoted(found["quoted"]))


def _unquoted(text: str) -> str:
    try:
        return json.loads(text, strict=False)
    except ValueError as error:
        raise UsageError(f"{text} is not a valid JSON string: {error}") from error


def _text(step: Step) -> str:
    if isinstance(step, Field):
        return "." + (step.name if re.fullmatch(_WORD, step.name) else json.dumps(step.name))
    if isinstance(step, Index):
        return f"[{step.index}]"
    if isinstance(step, All):
        return "[:]"
    is_plain = step.text and not set('"]') & set(step.text)
    return f"[{step.key}={step.text if is_plain else json.dumps(step.text)}]"


def _take(node: Any, step: Step) -> Sequence[Any]:
    """The nodes one step further. Raises `LookupError` saying why there is none."""
    if isinstance(step, Field):
        return [_field(node, step.name)]
    if not _is_list(node):
        raise LookupError("not a list")
    if isinstance(step, All):
        return node
    if isinstance(step, Index):
        if step.index >= len(node):
            raise LookupError(f"the list has {len(node)} elements")
        return [node[step.index]]
    found = [element for element in node if str(_field(element, step.key)) == step.text]
    if len(found) != 1:
        known = [str(_field(element, step.key)) for element in node]
        hint = "" if found else nearest(step.text, known)
        raise LookupError(f"{len(found)} elements have this {step.key}{hint}; known: {', '.join(known) or 'none'}")
    return found


def _field(node: Any, name: str) -> Any:
    if isinstance(node, Message):
        known = node.DESCRIPTOR.fields_by_name
        if name in known:
            if known[name].has_presence and not node.HasField(name):
                raise LookupError("not set in this message")
            return getattr(node, name)
    elif isinstance(node, dict):
        known = node
        if name in known:
            return known[name]
    elif _is_list(node):
        raise LookupError(f"no field {name!r} in a list; choose its elements by [0], [:] or [name=...]")
    else:
        raise LookupError(f"no field {name!r} in a plain value")
    raise LookupError(f"no field {name!r}{nearest(name, known)}; known: {', '.join(known) or 'none'}")


def _is_list(node: Any) -> bool:
    return isinstance(node, Sequence) and not isinstance(node, str | bytes)
