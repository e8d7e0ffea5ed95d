"""How often each kind of frame is learnt from: old demonstrations, corrections, and other rollouts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data.schema import ACTION, ACTOR, EXECUTED_ACTION, ROUND
from manip_il.engine.drivers import action_gap
from manip_il.errors import UsageError
from manip_il.mdp import Actor
from manip_il.option import option

F64 = NDArray[np.float64]
COLUMNS = (ROUND, ACTOR, EXECUTED_ACTION, ACTION)
CORRECTION = 0.25  # of the longest step: where expert and learner differ by more, the label corrects


@dataclass(frozen=True)
class Sampling:
    """Relative weight of a frame. All equal: each frame once an epoch.

    demonstrations: of round 0. corrections: of later rounds, where the expert drove or differed from who did by more
    than `CORRECTION`. rollouts: the others of later rounds.
    """

    demonstrations: float = option(1.0, "weight of a frame of round 0")
    corrections: float = option(1.0, "weight of a later frame where the expert drove or would have acted differently")
    rollouts: float = option(1.0, "weight of the other later frames")

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if not 0 <= value < np.inf:
                raise UsageError(f"sampling.{one.name} is {value}; expected 0 or more")
        if self.demonstrations == 0:
            raise UsageError("sampling.demonstrations is 0, but round 0 has nothing else to learn from")

    @property
    def is_even(self) -> bool:
        """Whether no kind is preferred."""
        return self.demonstrations == self.corrections == self.rollouts

    def weights(self, table: Mapping[str, NDArray[Any]], scale: F64) -> F64 | None:
        """Return the weight of every frame of a table with `COLUMNS`, (N,); None where all are equal.

        scale: see `action_gap`.
        """
        if self.is_even:
            return None
        gap = action_gap(table[ACTION], table[EXECUTED_ACTION], scale)
        by_expert = table[ACTOR].reshape(-1) != Actor.LEARNER
        later = np.where(by_expert | (gap > CORRECTION), self.corrections, self.rollouts)
        return np.where(table[ROUND].reshape(-1) == 0, self.demonstrations, later).astype(np.float64)
