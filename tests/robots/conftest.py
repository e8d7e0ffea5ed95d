from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from manip_il.robots import reach
from manip_il.robots.reach import Reach
from manip_il.robots.robot import Robot, get_robot

from .own import write


@pytest.fixture
def own(tmp_path: Path) -> Robot:
    """An arm of a user's own."""
    return get_robot(str(write(tmp_path)))


@pytest.fixture
def everywhere(monkeypatch, tmp_path: Path) -> None:
    """Every robot reaches everything: no map is worked out, and none is kept among the user's."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(reach, "_solve", lambda robot: Reach(np.array([-1.0, -1.0, 0.0]), np.zeros((41, 41, 21))))
