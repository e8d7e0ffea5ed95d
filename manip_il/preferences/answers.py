"""Answers about pairs of clips: `preferences.json`, and several of them joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError, MismatchError, UnknownName
from manip_il.preferences.pairs import Pairs, read_file

FILE_NAME = "preferences.json"
FORMAT, VERSION = "manip_il preferences", 1
LEFT, RIGHT, EQUAL, SKIP = ANSWERS = ("left", "right", "equal", "skip")
BETTER = {LEFT: 1.0, RIGHT: 0.0, EQUAL: 0.5}  # how much of the left clip being better an answer says


@dataclass(frozen=True)
class Answer:
    """An answer about a pair, by its number. when: ISO 8601; None of a simulated teacher."""

    pair: int
    answer: str
    when: str | None = None

    def __post_init__(self) -> None:
        if self.answer not in ANSWERS:
            raise UnknownName(f"answer about pair {self.pair}:", self.answer, ANSWERS)


@dataclass(frozen=True)
class Preferences:
    """Answers of one person or teacher. pairs: the hash of the pairs that they are about."""

    pairs: str
    who: str
    answers: tuple[Answer, ...]

    def to_json(self) -> dict[str, Any]:
        """Return everything for `preferences.json`."""
        return {"format": FORMAT, "version": VERSION, **asdict(self)}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Preferences:
        """Return the inverse of `to_json`."""
        return cls(data["pairs"], data["who"], tuple(Answer(**one) for one in data["answers"]))

    @classmethod
    def read(cls, path: Path, pairs: Sequence[Pairs]) -> Preferences:
        """Return the answers in a file, with the numbers that its pairs have among those of all files (`join_pairs`).

        Raises `ManipError` for a file that holds no answers, or answers about other pairs.
        """
        found = read_file(path, FORMAT, VERSION, cls.from_json)
        place = next((number for number, one in enumerate(pairs) if one.sha256 == found.pairs), None)
        if place is None:
            own = pairs[0].sha256
            raise MismatchError("pairs (sha256)", str(path), found.pairs[:12], "the file of pairs", own[:12])
        before = sum(map(len, pairs[:place]))
        for one in found.answers:
            if not 0 <= one.pair < len(pairs[place]):
                last = len(pairs[place]) - 1
                raise ManipError(f"{path} has an answer about pair {one.pair}; there are pairs 0 to {last}")
        return replace(found, answers=tuple(replace(one, pair=before + one.pair) for one in found.answers))


@dataclass(frozen=True, eq=False)
class Answers:
    """All answers but skips. pair: number of each one's, (A,); better: of the left clip, (A,), one of `BETTER`.

    skipped: answers that were `skip`. contradictory: pairs of which one answer says left and another right.
    """

    pair: NDArray[np.int64]
    better: NDArray[np.float64]
    skipped: int
    contradictory: int


def join_answers(given: Sequence[Preferences]) -> Answers:
    """Return answers as one; two about a pair are two observations, also where they contradict each other."""
    every = [one for preferences in given for one in preferences.answers]
    kept = [one for one in every if one.answer != SKIP]
    left, right = ({one.pair for one in kept if one.answer == answer} for answer in (LEFT, RIGHT))
    return Answers(
        np.array([one.pair for one in kept], np.int64),
        np.array([BETTER[one.answer] for one in kept], np.float64),
        len(every) - len(kept),
        len(left & right),
    )
