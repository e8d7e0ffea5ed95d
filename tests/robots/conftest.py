from __future__ import annotations

from pathlib import Path

import pytest

from manip_il.robots import files, table
from manip_il.robots.robot import Robot
from manip_il.robots.table import get_robot

from .own import write


@pytest.fixture(autouse=True)
def tried_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Models are tried in this process: a child takes half a second to start."""
    monkeypatch.setattr(table, "try_models", lambda name, *models: files._compile(name, models))


@pytest.fixture
def own(tmp_path: Path, tried_here: None) -> Robot:
    """An arm of a user's own."""
    return get_robot(str(write(tmp_path)))
