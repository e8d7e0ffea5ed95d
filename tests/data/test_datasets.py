"""Writing, reading and merging datasets with pyarrow alone."""

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.build import merge_datasets
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_write import write_dataset
from manip_il.errors import ManipError, MismatchError
from manip_il.mdp import Episode

from ..damage import digests, edit_json
from ..pictures import assert_comes_back, write

FINGERPRINT = {"mujoco": "3.11.0"}
HERE = Path(__file__).parent
OPTIONS: dict[str, Any] = {"fingerprint": FINGERPRINT}
ORIGIN = {"recorded": 3, "failed": 1}


@pytest.fixture
def root(tmp_path: Path, episodes: list[Episode], spec: s.EnvironmentSpec) -> Path:
    write_dataset(episodes, tmp_path / "lift", spec, provenance=ORIGIN, **OPTIONS)
    return tmp_path / "lift"


def test_episodes_come_back_bit_for_bit(root, episodes):
    assert_comes_back(root, episodes)


def test_what_a_dataset_says_of_itself(root, spec):
    assert Dataset.open(root).spec == spec
    assert Dataset.open(root).fingerprint == FINGERPRINT
    assert Dataset.open(root).provenance == ORIGIN
    info = Dataset.open(root).info
    assert (info.robot, info.fps, info.episodes, info.frames) == ("panda", 20, 3, 20)
    assert Dataset.open(root).count_successes() == 2
    edit_json(root / layout.OURS, lambda ours: ours["spec"].pop("schema"))
    with pytest.raises(ManipError, match=r"manip_il\.json: .*written with schema 1"):
        _ = Dataset.open(root).spec


def test_episodes_come_one_by_one_nothing_is_there_before_the_last_and_the_bytes_are_the_same(
    root, tmp_path, episodes, spec
):
    again, origin = tmp_path / "elsewhere" / "again", dict[str, Any]()

    def one_by_one() -> Iterator[Episode]:
        for episode in episodes:
            yield episode
            assert not again.exists()
        origin.update(ORIGIN)

    info = write_dataset(one_by_one(), again, spec, origin, **OPTIONS)
    assert info == Dataset.open(again).info
    assert digests(again) == digests(root)


def test_statistics_are_those_of_all_frames_and_quantiles_the_means_of_the_episodes(root, episodes):
    table = Dataset.open(root).columns()
    ends = np.cumsum([len(episode) for episode in episodes])
    for key, stats in json.loads((root / layout.STATS).read_text()).items():
        values = table[key].astype(np.float64)
        assert stats["count"] == [20]
        for name, function in (
            ("min", np.min),
            ("max", np.max),
            ("mean", np.mean),
            ("std", np.std),
        ):
            np.testing.assert_allclose(
                stats[name], np.atleast_1d(function(values, axis=0)), rtol=1e-12, atol=1e-12
            )
        for name, share in layout.QUANTILES.items():
            parts = np.split(values, ends[:-1])
            each = [
                len(part) * np.quantile(part, share, axis=0, method="inverted_cdf")
                for part in parts
            ]
            np.testing.assert_allclose(stats[name], np.atleast_1d(sum(each) / 20), atol=1e-12)


def test_a_merge_equals_writing_all_episodes(tmp_path, make_episode, spec):
    episodes = [make_episode(seed, length=5 + seed) for seed in range(6)]
    write_dataset(episodes[:4], tmp_path / "a", spec, provenance={"recorded": 4}, **OPTIONS)
    write_dataset(episodes[4:], tmp_path / "b", spec, **OPTIONS)
    write_dataset(episodes, tmp_path / "direct", spec, **OPTIONS)
    info = merge_datasets([tmp_path / "a", tmp_path / "b"], tmp_path / "merged")
    assert info.episodes == 6
    merged, direct = digests(tmp_path / "merged"), digests(tmp_path / "direct")
    assert merged.pop(layout.OURS) != direct.pop(layout.OURS)  # where the episodes came from
    assert merged == direct
    sources = [{"name": "a", "provenance": {"recorded": 4}}, {"name": "b", "provenance": {}}]
    assert Dataset.open(tmp_path / "merged").provenance == {"merged": sources}


@pytest.mark.parametrize("change", [{"robot": "fetch"}, {"image_size": (8, 8)}])
def test_a_merge_of_different_robots_or_pictures_is_refused_naming_both(
    root, tmp_path, episodes, spec, change
):
    write_dataset(episodes, tmp_path / "other", dataclasses.replace(spec, **change), **OPTIONS)
    ((what, value),) = change.items()
    with pytest.raises(
        MismatchError,
        match=(
            rf"{what} differs: .*lift has {re.escape(str(getattr(spec, what)))}, .*other has"
            rf" {re.escape(str(value))}"
        ),
    ):
        merge_datasets([root, tmp_path / "other"], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def test_a_merge_warns_of_different_environments(root, tmp_path, episodes, spec, caplog):
    write_dataset(episodes, tmp_path / "old", spec, fingerprint={"mujoco": "3.10.0"})
    merge_datasets([root, tmp_path / "old"], tmp_path / "merged")
    assert "mujoco differs" in caplog.text
    assert "3.10.0" in caplog.text


def test_a_new_file_starts_where_one_is_full_and_a_missing_one_is_noticed(tmp_path, episodes, spec):
    write(episodes * 4, tmp_path / "small", spec, size=0.01)
    files = sorted((tmp_path / "small").glob(layout.DATA_FILES))
    assert len(files) > 1
    assert Dataset.open(tmp_path / "small").columns(["index"])["index"].tolist() == list(range(80))
    files[-1].unlink()
    with pytest.raises(ManipError, match="counts 80 frames"):
        Dataset.open(tmp_path / "small").columns()
