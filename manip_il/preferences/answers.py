"""Answers about pairs of clips: `preferences.json`, and several of them joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.errors import ManipError, MismatchError, UnknownName
from manip_il.preferences.pairs import MOST_PAIRS, Pairs, check_format

FILE_NAME = "preferences.json"
FORMAT, VERSION = "manip_il preferences", 1
LEFT, RIGHT, EQUAL, SKIP = ANSWERS = ("left", "right", "equal", "skip")
BETTER = {LEFT: 1.0, RIGHT: 0.0, EQUAL: 0.5}  # how much of the left clip being better an answer says
_MOST_ANSWERS = 10 * MOST_PAIRS
_LARGEST = 64 * 1024 * 1024  # [bytes]
_LONGEST_WHO = 200  # characters


@dataclass(frozen=True)
class Answer:
    """An answer about a pair, by its number. when: ISO 8601; None of a simulated teacher."""

    pair: int
    answer: str
    when: str | None = None

    def __post_init__(self) -> None:
        checks.whole("number of a pair", self.pair, 0, MOST_PAIRS)
        if checks.text("answer", self.answer, checks.LONGEST_NAME) not in ANSWERS:
            raise UnknownName(f"answer about pair {self.pair}:", self.answer, ANSWERS)
        if self.when is not None:
            try:
                datetime.fromisoformat(checks.text("when", self.when, checks.LONGEST_NAME))
            except ValueError as error:
                raise ManipError(f"when is {checks.shorten(self.when)}; expected a time such as {_TIME}") from error


_TIME = "2026-01-31T12:00:00Z"


@dataclass(frozen=True)
class Preferences:
    """Answers of one person or teacher. pairs: the hash of the pairs that they are about."""

    pairs: str
    who: str
    answers: tuple[Answer, ...]

    def __post_init__(self) -> None:
        checks.text("pairs", self.pairs, checks.LONGEST_NAME)
        checks.text("who", self.who, _LONGEST_WHO)
        checks.array("answers", self.answers, _MOST_ANSWERS)

    def to_json(self) -> dict[str, Any]:
        """Return everything for `preferences.json`."""
        answers = [{"pair": one.pair, "answer": one.answer, "when": one.when} for one in self.answers]
        return {"format": FORMAT, "version": VERSION, "pairs": self.pairs, "who": self.who, "answers": answers}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Preferences:
        """Return the inverse of `to_json`. Raises `ManipError` for what no preferences hold."""
        check_format(data, FORMAT, VERSION)
        if missing := {"pairs", "who", "answers"} - data.keys():
            raise ManipError(f"preferences without {', '.join(sorted(missing))}")
        given = checks.array("answers", data["answers"], _MOST_ANSWERS)
        return cls(data["pairs"], data["who"], tuple(_answer(number, one) for number, one in enumerate(given)))

    @classmethod
    def read(cls, path: Path, pairs: Sequence[Pairs]) -> Preferences:
        """Return the answers in a file, with the numbers that its pairs have among those of all files (`join_pairs`).

        Raises `ManipError` naming the file for what its answers cannot be, or of other pairs.
        """
        data = checks.read_json(path, "answers of manip-il reward ask or answer", _LARGEST)
        try:
            found = cls.from_json(data)
        except ManipError as error:
            raise ManipError(f"{path}: {error}") from error
        place = next((number for number, one in enumerate(pairs) if one.sha256 == found.pairs), 0)
        own, before = pairs[place], sum(map(len, pairs[:place]))
        for one in found.answers:
            if one.pair >= len(own):
                raise ManipError(f"{path} has an answer about pair {one.pair}; there are pairs 0 to {len(own) - 1}")
        if found.pairs != own.sha256:
            raise MismatchError("pairs (sha256)", str(path), found.pairs[:12], "the file of pairs", own.sha256[:12])
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
    said = {answer: {one.pair for one in kept if one.answer == answer} for answer in (LEFT, RIGHT)}
    return Answers(
        np.array([one.pair for one in kept], np.int64),
        np.array([BETTER[one.answer] for one in kept], np.float64),
        len(every) - len(kept),
        len(said[LEFT] & said[RIGHT]),
    )


def _answer(number: int, data: Any) -> Answer:
    values = checks.mapping(f"answer {number}", data)
    if not {"pair", "answer"} <= values.keys() <= {"pair", "answer", "when"}:
        raise ManipError(f"answer {number} has {checks.shorten(sorted(values))}; expected pair, answer, when")
    return Answer(values["pair"], values["answer"], values.get("when"))
