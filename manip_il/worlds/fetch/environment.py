"""Fetch's environments of gymnasium-robotics, unmodified, as a world."""

import contextlib
import io
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any, override

import gymnasium
import mujoco
import numpy as np
from gymnasium.wrappers import TransformObservation
from numpy.typing import NDArray

from manip_il.mdp import F64, Label, State
from manip_il.robots.action_space import ActionSpace
from manip_il.worlds.contract import EnvironmentSpec
from manip_il.worlds.fetch.expert import LADDERS, REACH, scene_of
from manip_il.worlds.gym.environment import GymEnv, GymKind, coordinates
from manip_il.worlds.gym.restoring import WHOLE, physics_of
from manip_il.worlds.gym.world import AGENT, AROUND, GymWorld

NAMES = ("gripper.x", "gripper.y", "gripper.z", "gripper.opening")
TOLERANCE = 0.05  # [m]
INSTRUCTIONS = {
    "FetchReach-v4": "Move the gripper to the goal",
    "FetchPush-v4": "Push the cube to the goal",
    "FetchPickAndPlace-v4": "Bring the cube to the goal",
}


class Fetch(GymWorld):
    """A Fetch environment; what its `step` and `reset` return is the goal, (3,) [m]."""

    name = "fetch_stock"
    tasks = tuple(INSTRUCTIONS)
    fps = 25
    horizon = 50
    phases = ("none", "approach", "grasp", "carry", "push", "hold")
    cameras = ()

    @override
    def make(self) -> Any:
        # gymnasium-robotics announces its versions there
        with contextlib.redirect_stderr(io.StringIO()):
            import_module("gymnasium_robotics")  # which registers its names
            # the horizon is its time limit
            env: Any = gymnasium.make(self.task, reward_type="sparse").unwrapped
        env._mujoco_step = partial(self._run_physics, env)
        env.action_space = gymnasium.spaces.Box(-1, 1, (len(NAMES),), np.float64)
        self.instruction = INSTRUCTIONS[self.task]
        self.names = {AGENT: NAMES, AROUND: _observed_names(env.has_object), "action": NAMES}
        return TransformObservation(env, lambda _: env.goal, None)

    @override
    def reset(self, env: Any, seed: int) -> tuple[F64, Mapping[str, Any]]:
        found = super().reset(env, seed)
        self._posed = _motion(env.unwrapped.data)
        return found

    @override
    def observe(self, env: Any, seen: F64) -> dict[str, F64]:
        """Return the gripper's position and opening, (4,) [m], and the environment's own
        observation and goal, (k,).
        """
        own = env.unwrapped._get_obs()["observation"]
        return {
            AGENT: np.append(own[:3], scene_of(env).opening),
            AROUND: np.append(own, env.unwrapped.goal),
        }

    @override
    def act(self, env: Any, seen: F64) -> Label:
        phase, way, fingers = LADDERS[self.task](scene_of(env))
        action = np.append(np.clip(way / REACH, -1, 1), fingers)
        return Label(action, self.phases.index(phase), True, 0.0)

    @override
    def progress(self, env: Any, info: Mapping[str, Any]) -> float:
        """Return the share of the task that is done: 1 within the tolerance, 0.5 at twice that
        distance.
        """
        scene = scene_of(env)
        left = np.linalg.norm(scene.object - scene.goal)
        return TOLERANCE / max(TOLERANCE, float(left))

    @override
    def positions(self, env: Any) -> dict[str, F64]:
        scene = scene_of(env)
        things = {"object": scene.object} if env.unwrapped.has_object else {}
        return {"hand": scene.gripper} | things

    @override
    def state(self, env: Any) -> F64:
        """Return MuJoCo's state, and the positions and velocities that poses follow from, (p,)."""
        inner = env.unwrapped
        # with closed fingers, the environment's step ends with computing all poses
        posed = _motion(inner.data) if inner.block_gripper else self._posed
        return np.concatenate([physics_of(inner.model, inner.data), posed])

    @override
    def restore(self, env: Any, state: F64) -> None:
        model, data = env.unwrapped.model, env.unwrapped.data
        size = mujoco.mj_stateSize(model, WHOLE)
        physics, self._posed = state[:size], state[size:]
        mujoco.mj_setState(model, data, physics, WHOLE)
        data.qpos[:], data.qvel[:] = self._posed[: model.nq], self._posed[model.nq :]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_setState(model, data, physics, WHOLE)

    def _run_physics(self, env: Any, action: NDArray[Any]) -> None:
        """Run the environment's physics steps in two calls, to store the positions and velocities
        before the last one.
        """
        mujoco.mj_step(env.model, env.data, nstep=env.n_substeps - 1)
        self._posed = _motion(env.data)
        mujoco.mj_step(env.model, env.data, nstep=1)


class FetchEnv(GymEnv):
    """An environment of Fetch behind the contract."""

    most_seed = 2**64
    hashes_code = False

    @override
    def set_state(self, state: State) -> None:
        super().set_state(state)
        env: Any = self.env.unwrapped
        env.goal = state.variation.copy()

    @override
    def _found_actions(self) -> ActionSpace:
        return replace(super()._found_actions(), scale=np.array([1.0, 1.0, 1.0, 2.0]))

    @override
    def _described(self, horizon: int) -> EnvironmentSpec:
        return replace(
            super()._described(horizon),
            action_meaning="displacement of the gripper in x, y, z [5 cm], fingers from -1 (close)"
            " to 1 (open)",
            state_names=(),
            ends_solved=False,
        )


WORLD = GymKind(Fetch, FetchEnv)


def _motion(data: mujoco.MjData) -> F64:
    """Return positions and velocities of all joints."""
    return np.concatenate([data.qpos, data.qvel])


def _observed_names(has_object: bool) -> tuple[str, ...]:
    """Return the names of the entries of `environment_state`, (k,)."""
    fingers = ("finger.right", "finger.left")
    names = (
        *coordinates("ee", "object", "object_offset"),
        *fingers,
        *coordinates("object_turn", "object_velocity", "object_spin", "ee_velocity"),
        *(f"{name}.velocity" for name in fingers),
        *coordinates("goal"),
    )
    return tuple(name for name in names if has_object or not name.startswith("object"))
