"""A dataset of synthetic episodes beside its journals; no network."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from manip_il.data import schema as s
from manip_il.data.build import build
from manip_il.data.fingerprint import environment_fingerprint
from manip_il.data.journal import write_episode
from manip_il.mdp import Episode

from ..synthetic import episodes, make_episode, offline, spec

__all__ = ["alone", "episodes", "journals", "make_episode", "offline", "root", "spec", "whole"]


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory, episodes: list[Episode], spec: s.RobotTaskSpec) -> Path:
    """A folder with a dataset, `lift`, and its journals, which no test changes."""
    folder = tmp_path_factory.mktemp("whole")
    for episode in episodes:
        write_episode(folder / "lift.journals", episode, spec, environment_fingerprint(b"", {}))
    build(folder / "lift.journals", folder / "lift")
    return folder


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
