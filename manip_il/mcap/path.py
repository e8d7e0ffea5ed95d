"""Paths to values in a message: `pose.position.x`, `data[0]`, `scalars[:].value`, `joints[name=elbow].position`.

`[:]` is every element of a list, `[name=elbow]` the one whose name is elbow. A name may hold any characters but dots
and square brackets, a text any but a closing bracket.
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
    """Raise `UsageError` for a text that is no path."""
    if not _PATH.fullmatch(path):
        expected = "names and selectors, as in joints[name=elbow].position, scalars[:].value, data[0]"
        raise UsageError(f"the path {path!r} is invalid; expected {expected}")


def values_at(path: str, message: Any) -> list[Any]:
    """Return the values that a path leads to, in order; a list at its end counts as its elements.

    message: of protobuf or ROS 2, or the content of JSON. Raises `ManipError` saying which step leads nowhere.
    """
    nodes = [message]
    for selector, name in _STEP.findall(path):
        nodes = [one for node in nodes for one in (_select(node, selector) if selector else [_field(node, name)])]
    return [value for node in nodes for value in (node if _is_list(node) else [node])]


def _select(node: Any, selector: str) -> Sequence[Any]:
    if not _is_list(node):
        raise ManipError(f"[{selector}] of what is not a list")
    if selector == ":":
        return node
    key, is_named, text = selector.partition("=")
    found = [one for one in node if str(_field(one, key)) == text] if is_named else node[int(key) : int(key) + 1]
    if len(found) != 1:
        raise ManipError(f"[{selector}] fits {len(found)} of {len(node)} elements; expected one")
    return found


def _field(node: Any, name: str) -> Any:
    known: Any = node if isinstance(node, dict) else getattr(node, "__slots__", ())  # a message of ROS has these
    if isinstance(node, Message):
        known = node.DESCRIPTOR.fields_by_name
    if name not in known:
        kind = " in a list; choose its elements by [0], [:] or [name=...]" if _is_list(node) else ""
        raise ManipError(f"no field {name!r}{kind}{nearest(name, known)}; known: {', '.join(known) or 'none'}")
    if isinstance(node, Message) and known[name].has_presence and not node.HasField(name):
        raise ManipError(f"{name} is not set in this message")  # protobuf would give zeros
    return node[name] if isinstance(node, dict) else getattr(node, name)


def _is_list(node: Any) -> bool:
    return isinstance(node, Sequence) and not isinstance(node, str | bytes)
