"""One rollout, several episodes of a dataset: parts, budgets, and the same bytes when it is
built again.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.data import schema as s
from manip_il.data.build import Recording, build
from manip_il.data.dataset import Dataset
from manip_il.data.episodes import parts
from manip_il.data.journal import Journal
from manip_il.errors import NothingToLearnError
from manip_il.mdp import Episode

from ..damage import digests


@pytest.fixture
def rollout(make_episode):
    """A learner's path of 4 frames without labels, then two branches of 3 with."""

    def make(seed: int) -> Episode:
        episode = make_episode(seed, 10)
        columns = {key: column.copy() for key, column in episode.columns.items()}
        columns[s.DONE][:, 0] = np.isin(np.arange(10), (3, 6, 9))
        columns[s.LABEL_VALID][:, 0] = np.arange(10) > 3
        columns[s.SUCCESS][:, 0] = np.arange(10) == 9
        return Episode(seed, columns, success=False, success_at_end=False)

    return make


def recorded(rollouts: list[Episode], spec, folder: Path, recording: Recording) -> Path:
    """The dataset as it is written while rollouts come; their journals beside it."""
    journals, root = folder / "d.journals", folder / "d"
    recording.write(journals)
    journal = Journal(journals, spec, {})
    for episode in rollouts:
        journal.write(episode)
    recording.make(((journal, episode) for episode in rollouts), root)
    return root


def labels(root: Path) -> list[int]:
    """Sound ones of each episode."""
    table = Dataset.open(root).columns((s.LABEL_VALID, "episode_index"))
    return np.bincount(table["episode_index"], weights=table[s.LABEL_VALID]).astype(int).tolist()


def test_parts_are_the_rollout_cut_behind_every_done(rollout):
    episode = rollout(7)
    pieces = parts(episode)
    assert [len(piece) for piece in pieces] == [4, 3, 3]
    assert [(piece.success, piece.success_at_end) for piece in pieces] == [
        (False, False),
        (False, False),
        (True, True),
    ]
    for key, column in episode.columns.items():
        np.testing.assert_array_equal(
            np.concatenate([piece.columns[key] for piece in pieces]), column
        )


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, [0, 3, 3, 0, 3, 3]),
        ({"only_labelled": True}, [3, 3, 3, 3]),
        ({"only_labelled": True, "labels": 7}, [3, 3, 1]),
        ({"only_labelled": True, "labels": 6}, [3, 3]),
        ({"only_successes": True}, [3, 3]),
        ({"only_successes": True, "episodes": 1}, [3]),
    ],
)
def test_a_dataset_has_what_the_recording_says_and_is_built_again_to_the_byte(
    changes, expected, rollout, spec, tmp_path
):
    recording = replace(Recording(), **changes)
    root = recorded([rollout(7), rollout(8)], spec, tmp_path, recording)
    assert labels(root) == expected
    sound = Dataset.open(root).columns([s.LABEL_VALID])[s.LABEL_VALID]
    if expected[-1] == 1:
        assert sound.tolist()[-3:] == [1, 0, 0]
    build(tmp_path / "d.journals", tmp_path / "again")
    assert digests(tmp_path / "again") == digests(root)


def test_rollouts_without_a_label_make_no_dataset(make_episode, spec, tmp_path):
    episode = make_episode(7)
    unasked = replace(
        episode, columns=episode.columns | {s.LABEL_VALID: np.zeros((len(episode), 1), np.int64)}
    )
    with pytest.raises(NothingToLearnError, match="the expert was never queried"):
        recorded([unasked], spec, tmp_path, Recording(only_labelled=True))
    assert not (tmp_path / "d").exists()
