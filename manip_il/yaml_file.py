"""YAML from outside: without tags that run code, and without aliases, which can grow beyond any memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from manip_il import checks
from manip_il.errors import UsageError

LARGEST = 256 * 1024  # of a file [bytes]: the parser takes a second for 100 kB
DEEPEST = 50  # levels
_LONGEST_WHY = 300  # of the parser's message [characters]


class _Loader(yaml.SafeLoader):
    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"an alias (*) in line {self.peek_event().start_mark.line + 1}; write the value out")
        self._depth += 1
        if self._depth > DEEPEST:
            raise yaml.YAMLError(f"nested deeper than {DEEPEST} levels")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


def parse_yaml(text: str) -> Any:
    """Return what a YAML text holds. Raises `ValueError`, in one line, for what is none, has aliases or is too deep."""
    try:
        return yaml.load(text, _Loader)
    except Exception as error:  # besides its own errors it raises whatever int() or datetime() do
        raise ValueError(" ".join(str(error).split())[:_LONGEST_WHY]) from error


def read_yaml(path: Path, what: str) -> Any:
    """Return what is in a file; `UsageError` where it cannot be read. what: the file should be, for the message."""
    data = checks.read_bytes(path, what, LARGEST, UsageError)
    try:
        return parse_yaml(data.decode())
    except ValueError as error:  # UnicodeDecodeError is one
        raise UsageError(f"{path} is not YAML: {error}") from error
