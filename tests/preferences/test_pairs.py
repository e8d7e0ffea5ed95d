"""Which clips are compared, and what a file of pairs may hold."""

from collections import Counter

import pytest

from manip_il.chapter.preferences.pairs import (
    Pairs,
    find_datasets,
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
