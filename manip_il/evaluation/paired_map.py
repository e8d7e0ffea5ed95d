"""The failures of two arms on one map each: what one of them alone failed in, and what both did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from manip_il.evaluation.comparison import Arm, Comparison
from manip_il.evaluation.failure_map import MapMark, Outcome, map_mark


def paired_marks(comparison: Comparison) -> tuple[tuple[MapMark, ...], tuple[MapMark, ...]]:
    """Return the left arm's and the right arm's marks, in the order of the test episodes.

    `failed`: the arm failed where the other did not, with several training seeds in more of them; `shared`: it failed,
    and the other at least as often.
    """
    left, right = _failures(comparison.left), _failures(comparison.right)
    return _marks(comparison.left, left, right), _marks(comparison.right, right, left)


def _failures(arm: Arm) -> dict[int, int]:
    """Test seed -> in how many training seeds the arm failed."""
    counts: dict[int, int] = {}
    for member in arm.members:
        for episode in member.result.episodes:
            counts[episode.seed] = counts.get(episode.seed, 0) + (not episode.success)
    return counts


def _marks(arm: Arm, own: Mapping[int, int], others: Mapping[int, int]) -> tuple[MapMark, ...]:
    count = len(arm.members)
    marks: list[MapMark] = []
    for episode in arm.members[0].result.episodes:
        failures = own[episode.seed]
        outcome: Outcome = "solved" if not failures else "failed" if failures > others[episode.seed] else "shared"
        mark = map_mark(episode, outcome)
        if mark is None:
            continue
        if count > 1:  # where it ended differs between training seeds
            mark = replace(mark, end=None, words=f"seed {episode.seed}, failed in {failures} of {count} training seeds")
        marks.append(mark)
    return tuple(marks)
