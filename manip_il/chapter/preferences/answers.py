"""Answers about pairs of clips: reading and joining `preferences.json` files, and simulated teachers.

Teachers compare clips by true progress (B-Pref, Lee et al. 2021, section 3):

    P(left is better) = sigmoid(beta (G(left) - G(right))),    G(clip) = sum over its steps of progress

The return G sums true progress over the clip's steps; B-Pref sums the task's reward. Progress is a property of the
state, so a clip is better if it is closer to success or gets there faster.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from manip_il.chapter.preferences.pairs import Clips, Pairs, read_file
from manip_il.errors import ManipError, MismatchError, UnknownName, UsageError
from manip_il.mdp import F64, I64

FILE_NAME = "preferences.json"
FORMAT, VERSION = "manip_il preferences", 1
ANSWERS = ("left", "right", "equal", "skip")
LEFT, RIGHT, EQUAL, SKIP = ANSWERS
BETTER = {LEFT: 1.0, RIGHT: 0.0, EQUAL: 0.5}  # probability that the left clip is better
_ROUNDING = 1e-9  # returns that differ by less than this are equal


@dataclass(frozen=True)
class Answer:
    """An answer about a pair. pair: the pair's number. when: time in ISO 8601; None if a simulated teacher answered."""

    pair: int
    answer: str
    when: str | None = None

    def __post_init__(self) -> None:
        if self.answer not in ANSWERS:
            raise UnknownName(f"answer about pair {self.pair}:", self.answer, ANSWERS)


@dataclass(frozen=True)
class Preferences:
    """Answers of one person or teacher. pairs: hash of the pairs that were compared."""

    pairs: str
    who: str
    answers: tuple[Answer, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the content of `preferences.json`."""
        return {"format": FORMAT, "version": VERSION, **asdict(self)}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Preferences:
        """Return the preferences that `to_json` has written."""
        return cls(data["pairs"], data["who"], tuple(Answer(**one) for one in data["answers"]))

    @classmethod
    def read(cls, path: Path, pairs: Sequence[Pairs]) -> Preferences:
        """Return the answers in a file, with pair numbers that count across the pairs of all files, as in `join_pairs`.

        Raises `ManipError` for a file without answers, `MismatchError` for answers about other pairs.
        """
        found = read_file(path, FORMAT, VERSION, cls.from_json)
        place = next((number for number, one in enumerate(pairs) if one.sha256 == found.pairs), None)
        if place is None:
            own = pairs[0].sha256
            raise MismatchError("sha256 of the pairs", str(path), found.pairs[:12], "the file of pairs", own[:12])
        before = sum(map(len, pairs[:place]))
        return replace(found, answers=tuple(replace(one, pair=before + one.pair) for one in found.answers))


@dataclass(frozen=True, eq=False)
class Answers:
    """All answers except skips. pair: numbers of the pairs, (A,); better: the answers as numbers, see `BETTER`, (A,).

    skipped: number of `skip` answers.
    """

    pair: I64
    better: F64
    skipped: int


def join_answers(given: Sequence[Preferences]) -> Answers:
    """Join answers; two answers about one pair are two observations, even if they contradict each other."""
    every = [one for preferences in given for one in preferences.answers]
    kept = [one for one in every if one.answer != SKIP]
    return Answers(
        np.array([one.pair for one in kept], np.int64),
        np.array([BETTER[one.answer] for one in kept], np.float64),
        len(every) - len(kept),
    )


@dataclass(frozen=True)
class Teacher:
    """One of `TEACHERS`, with B-Pref's parameters.

    temperature: 1 / beta; if 0, the better clip is always chosen. epsilon: share of answers that are reversed.
    """

    name: str
    temperature: float = 0.0
    epsilon: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Teacher:
        """Parse `perfect`, `boltzmann[:TEMPERATURE]` or `mistaken[:SHARE]`; `UsageError` for anything else."""
        name, _, number = text.partition(":")
        if name not in TEACHERS:
            raise UnknownName("teacher", name, TEACHERS)
        field, default = TEACHERS[name]
        try:
            value = float(number or default)
        except ValueError:
            value = math.nan
        if not 0 <= value <= (1 if field == "epsilon" else math.inf):
            raise UsageError(f"--teacher is {text!r}; expected perfect, boltzmann:TEMPERATURE or mistaken:SHARE")
        return cls(text, **{field: value})

    def answers(self, clips: Clips, rng: np.random.Generator) -> list[str]:
        """Return the teacher's answer about every pair. Raises `ManipError` if the sources have no true progress."""
        if clips.progress is None:
            raise ManipError("the sources have no progress column, which teachers need; use manip-il reward ask")
        returns = clips.progress[clips.rows].sum(-1)
        difference, chance = returns[:, 0] - returns[:, 1], rng.random(len(returns))
        mistaken = rng.random(len(returns)) < self.epsilon
        left = chance < expit(difference / self.temperature) if self.temperature else difference > 0
        found = np.where(left != mistaken, LEFT, RIGHT)
        if not self.temperature:
            found[np.abs(difference) < _ROUNDING] = EQUAL
        return found.tolist()


# name -> the parameter that the number after the name sets, and its default
TEACHERS = {"perfect": ("epsilon", 0.0), "boltzmann": ("temperature", 1.0), "mistaken": ("epsilon", 0.1)}


def answer_pairs(teacher: Teacher, clips: Clips, rng: np.random.Generator) -> Preferences:
    """Return a teacher's preferences about the pairs, reproducible from the state of `rng`."""
    answers = [Answer(number, one) for number, one in enumerate(teacher.answers(clips, rng))]
    return Preferences(clips.pairs.sha256, f"teacher {teacher.name}", tuple(answers))
