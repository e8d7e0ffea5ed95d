"""Simulated teachers, who compare clips by true progress (B-Pref, Lee et al. 2021, section 3).

    P(left is better) = sigmoid(beta (G(left) - G(right)))
    G(clip) = sum over its steps t = 1 ... L of gamma^(L - t) progress_t

A clip's return is the sum of progress over its steps, as B-Pref's is of the task's reward: progress is what is true of
a state, so a clip that is farther on is the better one, and one that gets on faster is, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
    of answers that are the wrong way round. delta_skip: a pair is skipped if both clips have less than this share of
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
        parameter, value, (low, high) = TEACHERS[name]
        if colon:
            try:
                value = checks.number("it", float(number), low, high)
            except (ValueError, ManipError) as error:
                expected = f"a number from {low:g} to {high:g}" if parameter else "no number"
                raise UsageError(f"--teacher is {text!r}; expected {expected} behind {name}:") from error
        if parameter == "temperature":
            return cls(text, beta=1 / value)
        return cls(text, **{parameter: value} if parameter else {})

    def answers(self, clips: Clips, rng: np.random.Generator) -> list[str]:
        """Return what it answers about every pair. Raises `ManipError` if the sources have no true progress."""
        if clips.progress is None:
            raise ManipError("the sources have no column progress, by which teachers compare; ask people")
        discounts = self.gamma ** np.arange(clips.pairs.length - 1, -1, -1)
        returns = (clips.progress[clips.rows] * discounts).sum(-1)
        difference, chance = returns[:, 0] - returns[:, 1], rng.random(len(returns))
        mistaken = rng.random(len(returns)) < self.epsilon
        left = difference > 0
        if not math.isinf(self.beta):
            left = chance < 1 / (1 + np.exp(-np.clip(self.beta * difference, -50, 50)))
        found = np.where(left != mistaken, LEFT, RIGHT)
        if math.isinf(self.beta):
            found[np.abs(difference) < _ALIKE] = EQUAL
        found[returns.max(axis=1) < self.delta_skip * returns.mean()] = SKIP
        return found.tolist()


# name -> what a number behind the name sets, its default, and its range
TEACHERS: dict[str, tuple[str, float, tuple[float, float]]] = {
    "perfect": ("", 0.0, (0.0, -1.0)),
    "boltzmann": ("temperature", 1.0, (1e-6, 1e6)),
    "mistaken": ("epsilon", 0.1, (0.0, 1.0)),
    "myopic": ("gamma", 0.9, (0.0, 1.0)),
    "skipping": ("delta_skip", 0.1, (0.0, 100.0)),
}


def answer_pairs(teacher: Teacher, clips: Clips, rng: np.random.Generator) -> Preferences:
    """Return a teacher's preferences; the same generator gives the same ones."""
    answers = [Answer(number, one) for number, one in enumerate(teacher.answers(clips, rng))]
    return Preferences(clips.pairs.sha256, f"teacher {teacher.name}", tuple(answers))
