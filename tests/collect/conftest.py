from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from manip_il.collect.workers import Engine
from manip_il.tasks.config import make_config

from .clones import clone

sys.path.insert(0, str(Path(__file__).parent))  # where workers find `kept`


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory) -> Path:
    """A policy for the default environment, hardly trained."""
    return clone(make_config(), 4, tmp_path_factory.mktemp("policy"), steps=20)


@pytest.fixture(scope="module")
def two_processes() -> Iterator[Engine]:
    with Engine(2) as engine:
        yield engine
