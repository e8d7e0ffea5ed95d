"""Simulated teachers, and answers joined."""

from dataclasses import replace

import numpy as np
import pytest

from manip_il.chapter.preferences.pairs import (
    Answer,
    Clips,
    Preferences,
    Teacher,
    answer_pairs,
    join_answers,
)

from .conftest import clips_of


@pytest.fixture(scope="module")
def many(datasets):
    return clips_of([datasets / "good", datasets / "bad"], 400, 5)


def answered(teacher: str, clips: Clips, seed: int) -> list[str]:
    found = answer_pairs(Teacher.parse(teacher), clips, np.random.default_rng(seed))
    return [one.answer for one in found.answers]


def share_right(teacher: str, clips) -> float:
    """Share of answers left or right that are the better clip by true progress."""
    given = np.array(answered(teacher, clips, seed=3))
    told = np.isin(given, ("left", "right"))
    left, right = clips.data.progress[clips.rows].mean(axis=-1).T
    return float(((given == "left") == (left > right))[told].mean())


def test_the_perfect_teacher_prefers_the_clip_with_more_progress(many):
    assert share_right("perfect", many) == 1


@pytest.mark.parametrize("epsilon", [0.1, 0.4])
def test_a_mistaken_teacher_is_wrong_in_its_share_of_the_answers(epsilon, many):
    assert share_right(f"mistaken:{epsilon}", many) == pytest.approx(1 - epsilon, abs=0.05)


def test_a_boltzmann_teacher_errs_the_more_the_higher_its_temperature(many):
    shares = [share_right(f"boltzmann:{temperature}", many) for temperature in (0.01, 1, 100)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.97
    assert shares[-1] == pytest.approx(0.5, abs=0.08)


def test_clips_that_are_alike_are_answered_equal(many):
    alike = replace(many.data, progress=np.full(len(many.data.inputs), 0.5))
    assert set(answered("perfect", Clips(many.pairs, many.roots, alike), seed=0)) == {"equal"}


def test_skips_are_counted_and_all_answers_kept(clips):
    one = Preferences(
        "p", "a", (Answer(0, "left"), Answer(1, "right"), Answer(2, "skip"), Answer(3, "equal"))
    )
    other = Preferences("p", "b", (Answer(0, "right"), Answer(1, "right")))
    found = join_answers([one, other])
    assert found.skipped == 1
    assert found.pair.tolist() == [0, 1, 3, 0, 1]
    assert found.better.tolist() == [1, 0, 0.5, 0, 0]
