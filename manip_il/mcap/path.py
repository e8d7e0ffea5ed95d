"""Paths to values in a message: `pose.position.x`, `data[0]`, `scalars[:].value`, `joints[name=elbow].position`.

`[:]` is every element of a list, `[name=elbow]` the one whose name is elbow. Names and texts of other characters are
quoted: `"odd name".x`, `joints[name="wrist [2]"]`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from google.protobuf.message import Message

from manip_il.errors import ManipError, UsageError, nearest

Step = str | int | slice | tuple[str, str]  # .name, [3], [:], [name=elbow]

_WORD = r"[^\W\d]\w*"
_QUOTED = r'"(?:[^"\\]|\\.)*"'
_NAME = re.compile(rf"\.?(?:(?P<word>{_WORD})|(?P<quoted>{_QUOTED}))")
_SELECTOR = re.compile(
    rf"\[(?:(?P<all>:)|(?P<index>\d+)|(?P<key>{_WORD})=(?:(?P<quoted>{_QUOTED})|(?P<text>[^\]\"][^\]]*)))\]"
)


@dataclass(frozen=True)
class FieldPath:
    """Path to values in a message; `str` gives its text."""

    steps: tuple[Step, ...]

    def __str__(self) -> str:
        return "".join(map(_step_text, self.steps)).removeprefix(".")

    def values(self, message: Any) -> list[Any]:
        """Return the values that the path leads to, in order. A list at its end counts as its elements.

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
    """Parse a path. Raises `UsageError` that shows where it is wrong."""
    steps: list[Step] = []
    place = 0
    while place < len(text) or not steps:
        match = (_SELECTOR if steps and text[place] == "[" else _NAME).match(text, place)
        if match is None or match.group().startswith(".") != bool(steps and match.re is _NAME):
            raise UsageError(
                f"the path {text!r} is invalid at character {place + 1}; expected names and selectors, "
                "as in joints[name=elbow].position, scalars[:].value, data[0]"
            )
        steps.append(_parse_step(match.groupdict()))
        place = match.end()
    return FieldPath(tuple(steps))


def _parse_step(found: dict[str, str | None]) -> Step:
    if found.get("all"):
        return slice(None)
    if index := found.get("index"):
        return int(index)
    text = found.get("word") or found.get("text") or _unquote(found["quoted"] or "")
    return (key, text) if (key := found.get("key")) else text


def _unquote(text: str) -> str:
    try:
        return json.loads(text, strict=False)
    except ValueError as error:
        raise UsageError(f"{text} is not a valid JSON string: {error}") from error


def _step_text(step: Step) -> str:
    if isinstance(step, str):
        return "." + (step if re.fullmatch(_WORD, step) else json.dumps(step))
    if isinstance(step, int):
        return f"[{step}]"
    if isinstance(step, slice):
        return "[:]"
    key, text = step
    is_plain = text and not set('"]') & set(text)
    return f"[{key}={text if is_plain else json.dumps(text)}]"


def _take(node: Any, step: Step) -> Sequence[Any]:
    """Return the nodes one step further. Raises `LookupError` saying why there is none."""
    if isinstance(step, str):
        return [_field(node, step)]
    if not _is_list(node):
        raise LookupError("not a list")
    if isinstance(step, slice):
        return node
    if isinstance(step, int):
        if step >= len(node):
            raise LookupError(f"the list has {len(node)} elements")
        return [node[step]]
    key, text = step
    known = [str(_field(element, key)) for element in node]
    found = [element for element, one in zip(node, known, strict=True) if one == text]
    if len(found) != 1:
        hint = "" if found else nearest(text, known)
        raise LookupError(f"{len(found)} elements have this {key}{hint}; known: {', '.join(known) or 'none'}")
    return found


def _field(node: Any, name: str) -> Any:
    if _is_list(node):
        raise LookupError(f"no field {name!r} in a list; choose its elements by [0], [:] or [name=...]")
    if not isinstance(node, Message | dict):
        raise LookupError(f"no field {name!r} in a plain value")
    known = node if isinstance(node, dict) else node.DESCRIPTOR.fields_by_name
    if name not in known:
        raise LookupError(f"no field {name!r}{nearest(name, known)}; known: {', '.join(known) or 'none'}")
    if isinstance(node, dict):
        return node[name]
    if known[name].has_presence and not node.HasField(name):
        raise LookupError("not set in this message")
    return getattr(node, name)


def _is_list(node: Any) -> bool:
    return isinstance(node, Sequence) and not isinstance(node, str | bytes)
