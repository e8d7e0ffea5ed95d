"""Paths to values in a message: `pose.position.x`, `data[0]`, `scalars[:].value`, `joints[name=elbow].position`.

`[:]` is every element of a list, `[name=elbow]` the one whose name is elbow. A name may hold any characters but dots
and square brackets, a text any but a closing bracket.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from typing import Any

from google.protobuf.message import Message

from manip_il.errors import ManipError, UsageError, nearest

_WORD = r"[^.\[\]]+"
_SELECTOR = r"\[(:|\d+|[^=\]]+=[^\]]+)\]"
_PATH = re.compile(rf"{_WORD}(\.{_WORD}|{_SELECTOR})*")
_STEP = re.compile(rf"{_SELECTOR}|({_WORD})")


@functools.cache
def parse_path(text: str) -> tuple[tuple[str, str], ...]:
    """Return a path's steps, each a selector and a name, of which one is empty. Raises `UsageError` for no path."""
    if not _PATH.fullmatch(text):
        expected = "names and selectors, as in joints[name=elbow].position, scalars[:].value, data[0]"
        raise UsageError(f"the path {text!r} is invalid; expected {expected}")
    return tuple(_STEP.findall(text))


def values_at(path: str, message: Any) -> list[Any]:
    """Return the values that a path leads to, in order; a list at its end counts as its elements.

    message: of protobuf, or the content of JSON. Raises `ManipError` saying which step leads nowhere, with the nearest
    name that does.
    """
    nodes = [message]
    for selector, name in parse_path(path):
        try:
            nodes = [one for node in nodes for one in (_select(node, selector) if selector else [_field(node, name)])]
        except LookupError as error:
            raise ManipError(f"{path}: {error.args[0]}") from None
    return [value for node in nodes for value in (node if _is_list(node) else [node])]


def _select(node: Any, selector: str) -> Sequence[Any]:
    """Return the elements that a selector chooses. Raises `LookupError` saying why there are none."""
    if not _is_list(node):
        raise LookupError(f"[{selector}] of what is not a list")
    if selector == ":":
        return node
    key, is_named, text = selector.partition("=")
    found = [one for one in node if str(_field(one, key)) == text] if is_named else node[int(key) : int(key) + 1]
    if len(found) != 1:
        known = f"; known: {', '.join(str(_field(one, key)) for one in node)}" if is_named else ""
        raise LookupError(f"[{selector}] fits {len(found)} of {len(node)} elements{known}")
    return found


def _field(node: Any, name: str) -> Any:
    if not isinstance(node, Message | dict):
        kind = "a list; choose its elements by [0], [:] or [name=...]" if _is_list(node) else "a plain value"
        raise LookupError(f"no field {name!r} in {kind}")
    known = node if isinstance(node, dict) else node.DESCRIPTOR.fields_by_name
    if name not in known:
        raise LookupError(f"no field {name!r}{nearest(name, known)}; known: {', '.join(known) or 'none'}")
    if isinstance(node, dict):
        return node[name]
    if known[name].has_presence and not node.HasField(name):
        raise LookupError(f"{name} is not set in this message")
    return getattr(node, name)


def _is_list(node: Any) -> bool:
    return isinstance(node, Sequence) and not isinstance(node, str | bytes)
