import sys
from pathlib import Path

import pytest

from manip_il.worlds.table import make_config

from .clones import clone

sys.path.insert(0, str(Path(__file__).parent))  # where workers find `kept`


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory) -> Path:
    """A policy for the default environment, hardly trained."""
    return clone(make_config(), 4, tmp_path_factory.mktemp("policy"), steps=20)
