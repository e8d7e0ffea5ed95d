"""One Fetch environment of gymnasium-robotics, unmodified, under this program's interface."""

from __future__ import annotations

import contextlib
import io
from importlib import import_module
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import MismatchError
from manip_il.mdp import F64, Observation, State
from manip_il.robots.action_space import ActionSpace
from manip_il.tasks.stock.base import WHOLE, StockBase
from manip_il.tasks.stock.table import STATE_NAMES, STOCK, TOLERANCE, StockTask


class StockActions(ActionSpace):
    """Actions [dx, dy, dz, fingers], each in [-1, 1] in every state."""

    def random_near(self, state: NDArray[np.floating], rng: np.random.Generator) -> F64:
        """Draw any action, (4,), whatever the state (4,) is."""
        return rng.uniform(self.low, self.high)


_ONES = np.ones(len(STATE_NAMES))
ACTIONS = StockActions(STATE_NAMES, -_ONES, _ONES, np.array([1.0, 1.0, 1.0, 2.0]), np.array([True, True, True, False]))


class StockEnv(StockBase):
    """An environment of gymnasium-robotics. task: the environment's name there."""

    actions = ACTIONS

    def __init__(self, task: str):
        self.task = STOCK[task]
        self.task_description = self.task.instruction
        self._env = _make(self.task)
        self.model: mujoco.MjModel = self._env.model
        self.data: mujoco.MjData = self._env.data
        self._env._mujoco_step = self._run_physics
        self.start(0)

    def start(self, seed: int) -> None:
        """Begin the episode of a seed, as the environment's `reset(seed=...)` does."""
        super().start(seed)
        self._remember()

    def advance(self, action: NDArray[Any]) -> NDArray[Any]:
        """Apply one action (4,) for one control step and return it. Raises `NotFiniteError`, `MismatchError`."""
        super().advance(action)
        if self.task.blocked:  # with closed fingers, the environment's step has recomputed all poses
            self._remember()
        return action

    @property
    def progress(self) -> float:
        """Share of the task that is done: 1 within the tolerance, 0.5 at twice that distance."""
        left = np.linalg.norm((self.object if self.task.has_object else self.gripper) - self.goal)
        return TOLERANCE / max(TOLERANCE, float(left))

    @property
    def gripper(self) -> F64:
        """Position between the fingers, (3,) [m]."""
        return self.data.site("robot0:grip").xpos

    @property
    def object(self) -> F64:
        """Position of the cube, (3,) [m]."""
        return self.data.site("object0").xpos

    @property
    def object_velocity(self) -> F64:
        """Velocity of the cube, (3,) [m/s]."""
        return self._env._utils.get_site_xvelp(self.model, self.data, "object0")

    @property
    def opening(self) -> float:
        """Distance between the fingers [m]."""
        return sum(float(self.data.joint(f"robot0:{side}_gripper_finger_joint").qpos[0]) for side in "rl")

    @property
    def goal(self) -> F64:
        """Desired goal, (3,) [m]."""
        return self._env.goal

    def observe(self) -> Observation:
        """Return the gripper's position and opening, (4,) [m], and the environment's own observation and goal, (k,)."""
        own = self._env._get_obs()
        state = np.append(own["observation"][:3], self.opening).astype(np.float32)
        return Observation(state, np.append(own["observation"], own["desired_goal"]).astype(np.float32))

    def get_state(self) -> State:
        """Return everything that the future depends on; `set_state` restores it bit for bit."""
        return State(
            np.concatenate([self._physics(), *self._begun]), self.goal.copy(), self._step, self._streak, self._ever
        )

    def set_state(self, state: State) -> None:
        """Restore a state of the same task. Raises `MismatchError` for a state of another task."""
        size, nq = mujoco.mj_stateSize(self.model, WHOLE), self.model.nq
        if len(state.physics) != (expected := size + nq + self.model.nv) or len(state.variation) != 3:
            raise MismatchError("size of the state", "the state", len(state.physics), self.task.name, expected)
        physics = state.physics[:size].copy()
        self._begun = (state.physics[size : size + nq].copy(), state.physics[size + nq :].copy())
        mujoco.mj_setState(self.model, self.data, physics, WHOLE)
        self.data.qpos[:], self.data.qvel[:] = self._begun
        mujoco.mj_fwdPosition(self.model, self.data)
        mujoco.mj_fwdVelocity(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, physics, WHOLE)
        self._env.goal = state.variation.copy()
        self._begin(state)

    @property
    def positions(self) -> dict[str, F64]:
        """Positions (3,) [m] of the hand, and of the cube if there is one."""
        return {"hand": self.gripper} | ({"object": self.object} if self.task.has_object else {})

    def _remember(self) -> None:
        """Store the positions and velocities that the poses are computed from."""
        self._begun = (self.data.qpos.copy(), self.data.qvel.copy())

    def _run_physics(self, action: NDArray[Any]) -> None:
        """Run the environment's physics steps in two calls, to store the state before the last one."""
        mujoco.mj_step(self.model, self.data, nstep=self._env.n_substeps - 1)
        self._remember()
        mujoco.mj_step(self.model, self.data, nstep=1)


def _make(task: StockTask) -> Any:
    """The environment without gymnasium's wrappers: the rollout's horizon is its time limit."""
    with contextlib.redirect_stderr(io.StringIO()):  # gymnasium-robotics announces its versions there
        import_module("gymnasium_robotics")  # which registers its names
        return gymnasium.make(task.name, reward_type="sparse").unwrapped
