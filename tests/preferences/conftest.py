"""Datasets whose progress is known, without a simulator: an object is brought along one axis,
well or badly.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.chapter.preferences.pairs import Clips, choose_pairs
from manip_il.data import schema as s
from manip_il.data.lerobot_write import write_dataset
from manip_il.learn.network import threads
from manip_il.mdp import Episode

from ..synthetic import MakeEpisode, make_episode, offline, spec

__all__ = ["make_episode", "offline", "spec"]
LENGTHS = {"good": 30, "bad": 60}


@pytest.fixture(autouse=True)
def _one_thread():
    with threads(1):
        yield


@pytest.fixture(scope="session")
def datasets(
    tmp_path_factory: pytest.TempPathFactory, make_episode: MakeEpisode, spec: s.EnvironmentSpec
) -> Path:
    """A folder with the datasets `good`, whose episodes get to the end, `bad`, whose episodes do
    not, and `other`.
    """
    folder = tmp_path_factory.mktemp("supply")
    spec = replace(spec, robot="arm")  # none that is known here, whose columns would be compared
    for number, (name, length) in enumerate(LENGTHS.items()):
        made = [
            brought(make_episode(100 * number + i, length, name == "good"), spec, name == "good")
            for i in range(8)
        ]
        write(folder / name, made, spec)
    write(folder / "other", [make_episode(7, 30)], replace(spec, task="reach"))
    return folder


def write(root: Path, episodes: list[Episode], spec: s.EnvironmentSpec) -> None:
    write_dataset(episodes, root, spec, fingerprint={})


@pytest.fixture(scope="session")
def clips(datasets: Path) -> Clips:
    """Sixty pairs of clips of ten steps of both datasets."""
    return clips_of([datasets / "good", datasets / "bad"], 60)


def brought(episode: Episode, spec: s.EnvironmentSpec, well: bool) -> Episode:
    """The episode with its object on the way from 0 to 1, all of it or a third and back.

    Progress is how far it is.
    """
    rng, steps = np.random.default_rng(episode.seed), len(episode)
    way = np.linspace(0, 1, steps) if well else 0.35 * np.sin(np.linspace(0, np.pi, steps))
    place = way + rng.normal(size=steps) * 0.01
    columns = {key: values.copy() for key, values in episode.columns.items()}
    columns[s.ENVIRONMENT_STATE][:, spec.environment_state_names.index("object.x")] = place
    columns[s.PROGRESS] = place.clip(0, 1).astype(np.float32)[:, None]
    return replace(episode, columns=columns)


def clips_of(roots: Sequence[Path], count: int, length: int = 10, seed: int = 0) -> Clips:
    return choose_pairs(list(roots), length, count, seed, np.random.default_rng(seed))
