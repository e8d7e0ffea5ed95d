"""What stock environments share: a count of steps, and how a state and a model are read."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NoReturn

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError
from manip_il.mdp import Observation, State

F64 = NDArray[np.float64]
WHOLE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class StockEnvironment(ABC):
    """An environment of another package whose state is saved and restored bit for bit."""

    world: ClassVar[None] = None  # its expert restores states
    task_description: str
    model: mujoco.MjModel
    data: mujoco.MjData
    reward: float

    def __reduce__(self) -> NoReturn:
        raise ManipError("a stock environment cannot be copied or pickled; use get_state()")

    @abstractmethod
    def start(self, seed: int) -> None:
        """Begin the episode of a seed, as the environment's `reset(seed=...)` does."""

    def begin_step(self) -> None:  # noqa: B027
        """Leave the world as it is: nothing disturbs it."""

    @abstractmethod
    def advance(self, action: NDArray[Any]) -> NDArray[Any]:
        """Apply one action (n,) for one control step; returns it. Raises `NotFiniteError`, `MismatchError`."""

    @abstractmethod
    def observe(self) -> Observation:
        """Return what a learner sees."""

    @abstractmethod
    def get_state(self) -> State:
        """Return everything that the future depends on; `set_state` restores it bit for bit."""

    @abstractmethod
    def set_state(self, state: State) -> None:
        """Restore a state of the same task. Raises `MismatchError` for another one's."""

    def redrawn(self, state: State, rng: np.random.Generator) -> State | None:
        """Return a state with other places of what nothing has touched yet; None for one that cannot be."""
        return state

    @property
    @abstractmethod
    def progress(self) -> float:
        """Share of the task that is done, 0 to 1."""

    @property
    @abstractmethod
    def positions(self) -> dict[str, F64]:
        """Positions (3,) [m] of `hand`, objects and `goal`."""

    @property
    def solved(self) -> bool:
        """State of the task after the last step."""
        return self._streak > 0

    @property
    def state_size(self) -> int:
        """Length of `State.to_vector`."""
        return len(self.get_state().to_vector())

    @property
    def model_bytes(self) -> bytes:
        """Compiled model of the environment."""
        buffer = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, buffer)
        return buffer.tobytes()

    def _begin(self, state: State | None = None) -> None:
        """Count from 0, or on from a state."""
        self._step, self._streak, self._ever = (state.step, state.streak, state.ever) if state else (0, 0, False)
        self.reward = 0.0

    def _count(self, reward: float, solved: bool) -> None:
        """Count a step and what came of it."""
        self.reward = reward
        self._step += 1
        self._streak = self._streak + 1 if solved else 0
        self._ever = self._ever or solved

    def _physics(self) -> F64:
        """MuJoCo's integration state."""
        physics = np.empty(mujoco.mj_stateSize(self.model, WHOLE))
        mujoco.mj_getState(self.model, self.data, physics, WHOLE)
        return physics
