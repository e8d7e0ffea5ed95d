"""Simulated teachers, who compare clips by true progress (B-Pref, Lee et al. 2021, section 3).

    P(left is better) = sigmoid(beta (G(left) - G(right)))
    G(clip) = sum over its steps t = 1 ... L of gamma^(L - t) progress_t

A clip's return is the sum of progress over its steps, as B-Pref's is of the task's reward: progress is what is true of
a state, so a clip that is farther on is the better one, and one that gets on faster is, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.preferences.answers import EQUAL, LEFT, RIGHT, SKIP, Answer, Preferences
from manip_il.preferences.pairs import Clips

F64 = NDArray[np.float64]
_ALIKE = 1e-9  # difference of returns that is rounding


@dataclass(frozen=True)
class Teacher:
    """B-Pref's parameters, in its notation.

    beta: rationality; infinite: the better clip always. gamma: a step later counts for the one before. epsilon: share
    of answers that are the wrong way round. delta_skip: a pair is skipped where both clips have less than this share of
    the mean return of all clips.
    """

    name: str
    beta: float = math.inf
    gamma: float = 1.0
    epsilon: float = 0.0
    delta_skip: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Teacher:
        """Return the teacher of `NAME` or `NAME:NUMBER`, see `TEACHERS`."""
        name, colon, number = text.partition(":")
        if name not in TEACHERS:
            raise UnknownName("teacher", name, TEACHERS)
        teacher, parameter, (low, high) = TEACHERS[name]
        if not colon:
            return teacher
        try:
            value = checks.number("it", float(number), low, high)
        except (ValueError, ManipError) as error:
            expected = f"a number from {low:g} to {high:g}" if parameter else "no number"
            raise UsageError(f"--teacher is {text!r}; expected {expected} behind {name}:") from error
        if parameter == "temperature":
            return replace(teacher, name=text, beta=1 / value)
        return replace(teacher, name=text, **{parameter: value})

    def answers(self, clips: Clips, rng: np.random.Generator) -> list[str]:
        """Return what it answers about every pair. Raises `ManipError` where the sources have no true progress."""
        if clips.progress is None:
            raise ManipError("the sources have no column progress, by which teachers compare; ask people")
        progress = clips.progress[clips.rows]
        length = clips.pairs.length
        returns = (progress * self.gamma ** np.arange(length - 1, -1, -1)).sum(-1)
        chance, mistaken = rng.random(len(returns)), rng.random(len(returns)) < self.epsilon
        skip = returns.max(axis=1) < self.delta_skip * returns.mean()
        return [self._answer(*row) for row in zip(returns[:, 0] - returns[:, 1], chance, mistaken, skip, strict=True)]

    def _answer(self, difference: float, chance: float, mistaken: bool, skip: bool) -> str:
        if skip:
            return SKIP
        if math.isinf(self.beta):
            if abs(difference) < _ALIKE:
                return EQUAL
            left = difference > 0
        else:
            left = chance < 1 / (1 + math.exp(-min(max(self.beta * difference, -50.0), 50.0)))
        return LEFT if left != mistaken else RIGHT


# name -> teacher, what a number behind the name sets, and its range
TEACHERS: dict[str, tuple[Teacher, str, tuple[float, float]]] = {
    "perfect": (Teacher("perfect"), "", (0.0, -1.0)),
    "boltzmann": (Teacher("boltzmann", beta=1.0), "temperature", (1e-6, 1e6)),
    "mistaken": (Teacher("mistaken", epsilon=0.1), "epsilon", (0.0, 1.0)),
    "myopic": (Teacher("myopic", gamma=0.9), "gamma", (0.0, 1.0)),
    "skipping": (Teacher("skipping", delta_skip=0.1), "delta_skip", (0.0, 100.0)),
}


def answer_pairs(teacher: Teacher, clips: Clips, rng: np.random.Generator) -> Preferences:
    """Return a teacher's preferences; the same generator gives the same ones."""
    answers = [Answer(number, one) for number, one in enumerate(teacher.answers(clips, rng))]
    return Preferences(clips.pairs.sha256, f"teacher {teacher.name}", tuple(answers))
