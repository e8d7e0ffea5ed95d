"""Paths to values in a message: `pose.position.x`, `data[0]`, `scalars[:].value`, `joints[name=elbow].position`.

`[:]` selects every element of a list, `[name=elbow]` the one whose name is elbow. A name may have any characters except
dots and square brackets, the text after `=` any except a closing bracket.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from google.protobuf.message import Message

from manip_il.errors import ManipError, UsageError, nearest

_NAME = r"[^.\[\]]+"
_SELECTOR = r"\[(:|\d+|[^=\]]+=[^\]]+)\]"
_PATH = re.compile(rf"{_NAME}(\.{_NAME}|{_SELECTOR})*")
_STEP = re.compile(rf"{_SELECTOR}|({_NAME})")


def check_path(path: str) -> None:
    """Raise `UsageError` for an invalid path."""
    if not _PATH.fullmatch(path):
        expected = "names and selectors, as in joints[name=elbow].position, scalars[:].value, data[0]"
        raise UsageError(f"the path {path!r} is invalid; expected {expected}")


def values_at(path: str, message: Any) -> list[Any]:
    """Return the values at a path, in order; if it ends at a list, the list's elements.

    message: a protobuf or ROS 2 message, or parsed JSON. Raises `ManipError` naming the part of `path` that is missing.
    """
    nodes = [message]
    for selector, name in _STEP.findall(path):
        nodes = [one for node in nodes for one in (_select(node, selector) if selector else [_field(node, name)])]
    return [value for node in nodes for value in (node if _is_list(node) else [node])]


def _select(node: Any, selector: str) -> Sequence[Any]:
    if not _is_list(node):
        raise ManipError(f"[{selector}] is applied to something that is not a list")
    if selector == ":":
        return node
    key, is_named, text = selector.partition("=")
    found = [one for one in node if str(_field(one, key)) == text] if is_named else node[int(key) : int(key) + 1]
    if len(found) != 1:
        raise ManipError(f"[{selector}] matches {len(found)} of {len(node)} elements; expected one")
    return found


def _field(node: Any, name: str) -> Any:
    known: Any = node if isinstance(node, dict) else getattr(node, "__slots__", ())  # ROS messages have slots
    if isinstance(node, Message):
        known = node.DESCRIPTOR.fields_by_name
    if name not in known:
        kind = " in a list; select elements by [0], [:] or [name=...]" if _is_list(node) else ""
        raise ManipError(f"no field {name!r}{kind}{nearest(name, known)}; known: {', '.join(known) or 'none'}")
    if isinstance(node, Message) and known[name].has_presence and not node.HasField(name):
        raise ManipError(f"{name} is not set in this message")  # protobuf would return zeros
    return node[name] if isinstance(node, dict) else getattr(node, name)


def _is_list(node: Any) -> bool:
    return isinstance(node, Sequence) and not isinstance(node, str | bytes)
