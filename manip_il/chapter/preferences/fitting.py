"""Fit a reward to answers about pairs, and measure how well it predicts held-out answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.chapter.preferences.answers import Answers
from manip_il.chapter.preferences.pairs import Clips
from manip_il.chapter.reward import Compared, Fit, RewardShape, fit_reward
from manip_il.evaluation.intervals import Proportion
from manip_il.mdp import F64

TIE = 0.01  # if the clips' mean progress differs by less, neither is better


@dataclass(frozen=True, eq=False)
class FittedReward:
    """A fit, and its agreement on held-out pairs; each network of the ensemble holds out some pairs.

    answered: agreement with the answers that are not `equal`; true: agreement with true progress, without pairs that
    differ by less than `TIE`; None if the datasets have no progress.
    """

    fit: Fit
    shape: RewardShape
    answered: Proportion
    true: Proportion | None

    def to_json(self) -> dict[str, Any]:
        """Return the content of `fit.json`."""
        return {
            "agreement_with_answers": _counts(self.answered),
            "agreement_with_progress": None if self.true is None else _counts(self.true),
            "epochs": self.fit.epochs,
        }


def fit_answers(
    clips: Clips, answers: Answers, shape: RewardShape, seed: int, on_epoch: Callable[[], None] = lambda: None
) -> FittedReward:
    """Fit a reward and measure it on held-out pairs. Raises what `fit_reward` raises."""
    rows = clips.rows[answers.pair]
    compared = Compared(rows[:, 0], rows[:, 1], answers.better, answers.pair)
    fit = fit_reward(clips.inputs, compared, shape, seed, on_epoch)
    right = (fit.logits > 0) == (answers.better > 0.5)
    difference, true = true_difference(clips), None
    if difference is not None:
        pairs, first = np.unique(answers.pair, return_index=True)
        clear = np.abs(difference[pairs]) >= TIE
        true = _proportion(((fit.logits[first] > 0) == (difference[pairs] > 0))[clear])
    return FittedReward(fit, shape, _proportion(right[answers.better != 0.5]), true)


def true_difference(clips: Clips) -> F64 | None:
    """Return the mean true progress of each left clip minus that of the right one, (P,); None without progress."""
    if clips.progress is None:
        return None
    means = clips.progress[clips.rows].mean(axis=-1)
    return means[:, 0] - means[:, 1]


def _proportion(right: NDArray[np.bool_]) -> Proportion:
    return Proportion(int(right.sum()), max(len(right), 1))


def _counts(one: Proportion) -> dict[str, Any]:
    return {"rate": one.rate, "interval": list(one.interval), "right": one.successes, "of": one.n}


def summary_lines(found: FittedReward, answers: Answers) -> list[str]:
    """Return a summary of the answers and the fit as plain lines."""
    given = f"{len(answers.better):,} answers about {len(set(answers.pair.tolist())):,} pairs"
    lines = [f"{given}, {answers.skipped:,} skipped, {answers.contradictory:,} pairs with contradictory answers"]
    lines.append(f"agreement with answers on held-out pairs: {found.answered}")
    if found.true is not None:
        lines.append(f"agreement with true progress on held-out pairs: {found.true} of {found.true.n:,}")
    return lines
