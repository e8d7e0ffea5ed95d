"""Synthetic episodes, some of them with pictures, and no network."""

from collections.abc import Callable

import pytest

from manip_il.mdp import Episode
from manip_il.worlds.contract import EnvironmentSpec

from ..pictures import numbered_episodes, with_cameras
from ..synthetic import episodes, make_episode, offline, spec

__all__ = ["episodes", "make_episode", "offline", "spec"]


@pytest.fixture(scope="session")
def two(spec: EnvironmentSpec) -> EnvironmentSpec:
    """The spec with two cameras."""
    return with_cameras(spec, "front", "wrist")


@pytest.fixture(scope="session")
def filmed(make_episode: Callable[..., Episode], two: EnvironmentSpec) -> list[Episode]:
    """Three episodes of 21 frames with numbered pictures of two cameras."""
    return numbered_episodes(make_episode, two)
