"""What stock environments share: counts of steps, and reading MuJoCo's state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, NoReturn

import mujoco
import numpy as np

from manip_il.errors import ManipError
from manip_il.mdp import F64, State

WHOLE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class StockRung(NamedTuple):
    """A phase: whether it holds in what an expert reads from a state, and its target there."""

    name: str
    holds: Callable[[Any], bool]
    target: Callable[[Any], Any]


def always(read: object) -> bool:
    """Return True: the rung holds in every state."""
    return True


class StockBase:
    """An environment of another package, whose reset and step are its own."""

    world: ClassVar[None] = None  # its expert restores states itself
    model: mujoco.MjModel
    data: mujoco.MjData

    def __reduce__(self) -> NoReturn:
        raise ManipError("a stock environment cannot be copied or pickled; use get_state()")

    def begin_step(self) -> None:
        """Do nothing: stock environments have no disturbances."""

    @property
    def solved(self) -> bool:
        """Whether the task is solved after the last step."""
        return self._streak > 0

    def _begin(self, state: State | None = None) -> None:
        """Start counting from 0, or from a state's counts."""
        self._step, self._streak, self._ever = (state.step, state.streak, state.ever) if state else (0, 0, False)
        self.reward = 0.0

    def _count(self, reward: float, solved: bool) -> None:
        """Count a step, its reward and whether it solved the task."""
        self.reward = reward
        self._step += 1
        self._streak = self._streak + 1 if solved else 0
        self._ever = self._ever or solved

    def _physics(self) -> F64:
        """MuJoCo's integration state."""
        physics = np.empty(mujoco.mj_stateSize(self.model, WHOLE))
        mujoco.mj_getState(self.model, self.data, physics, WHOLE)
        return physics
