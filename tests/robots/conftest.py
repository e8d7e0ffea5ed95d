from pathlib import Path

import pytest

from manip_il.robots.robot import Robot
from manip_il.robots.table import get_robot

from .own import write


@pytest.fixture
def own(tmp_path: Path) -> Robot:
    """An arm of a user's own."""
    return get_robot(write(tmp_path))
