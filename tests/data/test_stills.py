"""Pictures that are PNGs in the data files come back bit for bit, by our readers and LeRobot's."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.bridges.doctor.examine import examine_folder
from manip_il.data import schema as s
from manip_il.data.build import merge_datasets
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_write import write_dataset
from manip_il.mdp import Episode

from ..pictures import episode_frames, read_episodes, write

FRONT, SIDE = s.IMAGES + "front", s.IMAGES + "side"


@pytest.fixture(scope="module")
def pictured(spec) -> s.EnvironmentSpec:
    return replace(spec, cameras=("front", "side"), image_size=(32, 48), video=False)


@pytest.fixture(scope="module")
def seen(episodes) -> list[Episode]:
    rng = np.random.default_rng(0)

    def pictures(episode: Episode) -> dict[str, np.ndarray]:
        return {
            key: rng.integers(0, 256, (len(episode), 32, 48, 3), np.uint8) for key in (FRONT, SIDE)
        }

    return [replace(episode, columns=episode.columns | pictures(episode)) for episode in episodes]


@pytest.fixture
def root(tmp_path: Path, seen, pictured) -> Path:
    write_dataset(seen, tmp_path / "stills", pictured, fingerprint={})
    return tmp_path / "stills"


def test_pictures_come_back_bit_for_bit(root, seen, pictured):
    assert Dataset.open(root).spec == pictured
    assert Dataset.open(root).cameras == [FRONT, SIDE]
    assert not (root / "videos").exists()
    for written, read in zip(seen, read_episodes(root), strict=True):
        for key, column in read.columns.items():
            np.testing.assert_array_equal(
                column.reshape(written.columns[key].shape), written.columns[key]
            )
    np.testing.assert_array_equal(episode_frames(root, SIDE, 2), seen[2].columns[SIDE])


def test_merged_with_films_they_become_films(root, seen, pictured, tmp_path):
    films = write(seen, tmp_path / "films", replace(pictured, video=True))
    for name, sources in (("a", [root, films]), ("b", [films, root])):
        merge_datasets(sources, tmp_path / name)
        assert examine_folder(tmp_path / name) == []
        frames = Dataset.open(films).frames(FRONT, np.arange(20))
        np.testing.assert_array_equal(
            Dataset.open(tmp_path / name).frames(FRONT, np.arange(40)), [*frames, *frames]
        )
