"""The stock environments, as rollouts, datasets, checkpoints and evaluations use a simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UsageError
from manip_il.mdp import State
from manip_il.robots.action_space import ActionSpace
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.tasks.config import EnvConfig
from manip_il.tasks.stock.environment import ACTIONS, StockEnv
from manip_il.tasks.stock.expert import StockExpert
from manip_il.tasks.stock.table import ROBOT


class StockSimulation:
    """The stock environments, each with a model of its own."""

    shares_models = False

    def make(
        self, config: EnvConfig, cameras: CameraConfig | None = None, conditions: Sequence[Condition] = ()
    ) -> StockEnv:
        """Make an environment. Raises `UsageError` for cameras, or conditions that change it."""
        require_no_cameras(cameras)
        if changed := [one.name for one in conditions if one.ranges]:
            raise UsageError(
                f"{ROBOT} is unmodified and takes no {', '.join(changed)}; use --suite=nominal, for manip-il dagger "
                "--disturbed_share=0"
            )
        return StockEnv(config.task)

    def expert(self, config: EnvConfig) -> StockExpert:
        """Make an expert."""
        return StockExpert(config.task)

    def actions(self, config: EnvConfig) -> ActionSpace:
        """Return the actions, (4,)."""
        return ACTIONS

    def state_size(self, config: EnvConfig) -> int:
        """Return how many numbers a `sim_state` has."""
        return _env(config.task).state_size

    def model_bytes(self, config: EnvConfig) -> bytes:
        """Return the environment's compiled model."""
        model = _env(config.task).model
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        return buffer.tobytes()

    def positions(self, config: EnvConfig, state: State) -> Mapping[str, NDArray[np.float64]]:
        """Return positions (3,) [m] of hand and goal, and of the cube where there is one."""
        env = _env(config.task)
        env.set_state(state)
        found = {"hand": env.gripper, "goal": env.goal}
        return found | ({"object": env.object} if env.task.has_object else {})


def require_no_cameras(cameras: CameraConfig | None) -> None:
    """Raise `UsageError` for cameras."""
    if cameras is not None:
        raise UsageError(f"{ROBOT} has no cameras here ({', '.join(cameras.names)}); leave out --cameras")


@cache
def _env(task: str) -> StockEnv:
    """An environment for descriptions, which no episode runs in."""
    return StockEnv(task)
