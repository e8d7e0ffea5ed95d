"""What stock environments share: counts of steps, and reading MuJoCo's state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, NoReturn

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError
from manip_il.mdp import F64, State
from manip_il.robots.action_space import ActionSpace

WHOLE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class StockRung(NamedTuple):
    """A phase of a stock expert. holds, target: functions of a `StockEnv` or an `AlohaScene` in the state to label."""

    name: str
    holds: Callable[[Any], bool]
    target: Callable[[Any], Any]


def always(read: object) -> bool:
    """Return True: the rung holds in every state."""
    return True


class StockBase:
    """An environment of another package, under this program's interface; reset and step are that package's."""

    world: ClassVar[None] = None  # a stock expert restores states itself
    actions: ActionSpace
    model: mujoco.MjModel
    data: mujoco.MjData
    _env: Any

    def __reduce__(self) -> NoReturn:
        raise ManipError("a stock environment cannot be copied or pickled; use get_state()")

    def start(self, seed: int) -> None:
        """Begin the episode of a seed, as the environment's `reset(seed=...)` does."""
        self._env.reset(seed=seed)
        self._begin()

    def advance(self, action: NDArray[Any]) -> NDArray[Any]:
        """Apply one action (n,) for one control step and return it. Raises `NotFiniteError`, `MismatchError`."""
        _, reward, _, _, info = self._env.step(self.actions.clip(action, self._step))
        solved = bool(info["is_success"])
        self.reward = float(reward)
        self._step += 1
        self._streak = self._streak + 1 if solved else 0
        self._ever = self._ever or solved
        return action

    @property
    def solved(self) -> bool:
        """Whether the task is solved after the last step."""
        return self._streak > 0

    def _begin(self, state: State | None = None) -> None:
        """Start counting from 0, or from a state's counts."""
        self._step, self._streak, self._ever = (state.step, state.streak, state.ever) if state else (0, 0, False)
        self.reward = 0.0

    def _physics(self) -> F64:
        """MuJoCo's integration state."""
        physics = np.empty(mujoco.mj_stateSize(self.model, WHOLE))
        mujoco.mj_getState(self.model, self.data, physics, WHOLE)
        return physics
