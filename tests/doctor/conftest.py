"""A dataset of synthetic episodes beside its journals; no network."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from manip_il.data import schema as s
from manip_il.data.build import build
from manip_il.data.fingerprint import environment_fingerprint
from manip_il.data.journal import Journal
from manip_il.mdp import Episode

from ..pictures import numbered_episodes, with_cameras
from ..synthetic import MakeEpisode, episodes, make_episode, offline, spec

__all__ = ["alone", "episodes", "journals", "make_episode", "offline", "root", "spec", "whole"]


def build_from_journals(folder: Path, episodes: list[Episode], spec: s.RobotTaskSpec) -> Path:
    for episode in episodes:
        Journal(folder / "lift.journals", spec, environment_fingerprint(b"", {})).write(episode)
    build(folder / "lift.journals", folder / "lift")
    return folder


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory, episodes: list[Episode], spec: s.RobotTaskSpec) -> Path:
    """A folder with a dataset, `lift`, and its journals, which no test changes."""
    return build_from_journals(tmp_path_factory.mktemp("whole"), episodes, spec)


@pytest.fixture(scope="session")
def filmed_once(tmp_path_factory: pytest.TempPathFactory, make_episode: MakeEpisode, spec: s.RobotTaskSpec) -> Path:
    """The same of a dataset that has a camera."""
    seen = with_cameras(spec, "front")
    return build_from_journals(tmp_path_factory.mktemp("filmed"), numbered_episodes(make_episode, seen), seen)


@pytest.fixture
def root(tmp_path: Path, whole: Path) -> Path:
    """A dataset beside its journals."""
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    return tmp_path / "lift"


@pytest.fixture
def journals(root: Path) -> Path:
    return root.with_name("lift.journals")


@pytest.fixture
def alone(root: Path, journals: Path) -> Path:
    """A dataset without its journals."""
    shutil.rmtree(journals)
    return root
