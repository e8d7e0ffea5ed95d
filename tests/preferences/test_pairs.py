"""Which clips are compared, and what a file of pairs may hold."""

import json
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import expit

from manip_il.chapter.preferences.pairs import (
    Answer,
    Pairs,
    Preferences,
    choose_pairs,
    find_datasets,
    join_pairs,
    read_clips,
)
from manip_il.errors import ManipError, MismatchError

from .conftest import clips_of


def test_every_source_is_in_as_many_pairs_as_any_other(clips):
    counts = Counter(clip.source for pair in clips.pairs.pairs for clip in pair)
    assert len(set(counts.values())) == 1


def test_no_pair_is_there_twice_and_no_clip_is_compared_with_itself(clips):
    every = [frozenset(pair) for pair in clips.pairs.pairs]
    assert len(set(every)) == len(every)
    assert all(len(pair) == 2 for pair in every)


def test_the_same_seed_chooses_the_same_pairs(datasets):
    roots = [datasets / "good", datasets / "bad"]
    assert clips_of(roots, 20).pairs == clips_of(roots, 20).pairs
    assert clips_of(roots, 20).pairs != clips_of(roots, 20, seed=1).pairs


def test_pairs_of_different_tasks_are_refused(datasets):
    with pytest.raises(MismatchError, match=r"task differs: .*good has lift, .*other has reach"):
        clips_of([datasets / "good", datasets / "other"], 1)


def test_an_ensemble_chooses_the_pairs_that_it_disagrees_about(datasets):
    def logits(inputs, sides):
        rewards = np.random.default_rng(1).normal(size=(3, inputs.shape[1])) @ inputs.T
        left, right = (rewards[:, sides[:, side]].sum(axis=-1) for side in (0, 1))
        return left - right

    roots, reward = (
        [datasets / "good", datasets / "bad"],
        SimpleNamespace(logits=logits, check_fits=lambda *_: None),
    )
    clips = [
        choose_pairs(roots, 10, 20, 0, np.random.default_rng(0), one) for one in (reward, None)
    ]
    doubts = [expit(logits(one.data.inputs, one.rows)).std(axis=0).mean() for one in clips]
    assert doubts[0] > 1.1 * doubts[1]


def test_a_run_stands_for_the_datasets_of_its_rounds(tmp_path, datasets):
    for number, name in enumerate(("good", "bad")):
        (tmp_path / f"round_{number:03d}").mkdir()
        (tmp_path / f"round_{number:03d}" / "dataset").symlink_to(datasets / name)
    assert [path.parent.name for path in find_datasets([tmp_path])] == ["round_000", "round_001"]


def test_a_dataset_that_was_changed_since_is_refused(clips):
    tree = clips.pairs.to_json()
    tree["sources"][0]["sha256"] = "0" * 64
    with pytest.raises(
        ManipError, match=r"dataset .*good is not among the sources, or has changed since"
    ):
        read_clips(Pairs.from_json(tree), clips.roots)


def test_no_path_in_a_file_of_pairs_is_opened(clips):
    tree = clips.pairs.to_json()
    for source in tree["sources"]:
        source["root"] = "nowhere"
    assert (read_clips(Pairs.from_json(tree), clips.roots).data.inputs == clips.data.inputs).all()


def test_answers_to_a_second_file_of_pairs_are_about_its_clips(datasets, tmp_path):
    """The second file's sources are in another order, and one is in both."""
    roots = [datasets / "good", datasets / "bad"]
    files = [clips_of(roots, 12).pairs, clips_of(roots[::-1], 7, seed=1).pairs]
    joined = join_pairs(files)
    assert len(joined) == 19
    assert [source.root for source in joined.sources] == list(map(str, roots))
    both = read_clips(joined, roots)
    alone = read_clips(files[1], roots)
    assert (both.data.inputs[both.rows[12:]] == alone.data.inputs[alone.rows]).all()
    path = tmp_path / "preferences.json"
    path.write_text(json.dumps(Preferences(files[1].sha256, "Ada", (Answer(3, "left"),)).to_json()))
    assert [one.pair for one in Preferences.read(path, files).answers] == [15]
