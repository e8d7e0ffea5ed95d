"""A reward from pairs and answers, and how well it foretells what it has not learnt from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.evaluation.intervals import Proportion
from manip_il.learn.reward import Compared, Fit, RewardShape, fit_reward
from manip_il.preferences.answers import Answers
from manip_il.preferences.pairs import Clips

F64 = NDArray[np.float64]
TIE = 0.01  # difference of the clips' mean progress below which none is the better one


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fit, and its agreement on pairs that were held out, each by one network of the ensemble.

    answered: with the answers left and right; true: with the clips' true progress, but where that differs by less than
    `TIE`; None where there is none.
    """

    fit: Fit
    shape: RewardShape
    answered: Proportion
    true: Proportion | None

    def to_json(self) -> dict[str, Any]:
        """Return the numbers for `fit.json`."""
        return {
            "agreement_with_answers": _counts(self.answered),
            "agreement_with_progress": None if self.true is None else _counts(self.true),
            "epochs": self.fit.epochs,
        }


def fit_answers(
    clips: Clips, answers: Answers, shape: RewardShape, seed: int, on_epoch: Callable[[], None] = lambda: None
) -> Fitted:
    """Fit a reward and measure it on held-out pairs. Raises what `fit_reward` raises."""
    rows = clips.rows[answers.pair]
    compared = Compared(rows[:, 0], rows[:, 1], answers.better, answers.pair)
    fit = fit_reward(clips.inputs, compared, shape, seed, on_epoch)
    right = (fit.logits > 0) == (answers.better > 0.5)
    difference, true = true_difference(clips), None
    if difference is not None:
        pairs, first = np.unique(answers.pair, return_index=True)
        told = np.abs(difference[pairs]) >= TIE
        true = _proportion(((fit.logits[first] > 0) == (difference[pairs] > 0))[told])
    return Fitted(fit, shape, _proportion(right[answers.better != 0.5]), true)


def true_difference(clips: Clips) -> F64 | None:
    """Return mean true progress of every pair's left clip minus that of its right one, (P,); None without progress."""
    if clips.progress is None:
        return None
    means = clips.progress[clips.rows].mean(axis=-1)
    return means[:, 0] - means[:, 1]


def _proportion(right: NDArray[np.bool_]) -> Proportion:
    return Proportion(int(right.sum()), max(len(right), 1))


def _counts(one: Proportion) -> dict[str, Any]:
    return {"rate": one.rate, "interval": list(one.interval), "right": one.successes, "of": one.n}


def summary_lines(found: Fitted, answers: Answers) -> list[str]:
    """Return what was learnt as plain lines."""
    told = f"{len(answers.better):,} answers about {len(set(answers.pair.tolist())):,} pairs"
    lines = [f"{told}, {answers.skipped:,} skipped, {answers.contradictory:,} pairs with contradictory answers"]
    lines.append(f"agreement with answers on held-out pairs: {found.answered}")
    if found.true is not None:
        lines.append(f"agreement with true progress on held-out pairs: {found.true} of {found.true.n:,}")
    return lines
