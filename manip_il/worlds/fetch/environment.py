"""One Fetch environment of gymnasium-robotics, unmodified, behind the contract of a world."""

import contextlib
import io
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, ClassVar, override

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import F64, Observation, State
from manip_il.robots.action_space import ActionSpace
from manip_il.sim.config import CameraConfig
from manip_il.worlds.contract import Outcome
from manip_il.worlds.packaged import TOLERANCE, WHOLE, PackagedEnv, coordinates

STATE_NAMES = ("gripper.x", "gripper.y", "gripper.z", "gripper.opening")


@dataclass(frozen=True)
class FetchTask:
    """A task of Fetch.

    Attributes:
        name: Name of the environment in gymnasium-robotics.
        instruction: The task in words, for policies that read them.
        has_object: Whether the goal is for a cube, and not for the gripper.
        blocked: Whether the fingers stay closed.
        phases: Names of the phases of all tasks.
    """

    name: str
    instruction: str
    has_object: bool = True
    blocked: bool = True
    phases: ClassVar[tuple[str, ...]] = ("none", "approach", "grasp", "carry", "push", "hold")


_TASKS = (
    FetchTask("FetchReach-v4", "Move the gripper to the goal", has_object=False),
    FetchTask("FetchPush-v4", "Push the cube to the goal"),
    FetchTask("FetchPickAndPlace-v4", "Bring the cube to the goal", blocked=False),
)
FETCH_TASKS = {task.name: task for task in _TASKS}


class FetchActions(ActionSpace):
    """Actions [dx, dy, dz, fingers], each in [-1, 1] in every state."""

    def random_near(self, state: NDArray[np.floating], rng: np.random.Generator) -> F64:
        """Draw any action, (4,), whatever the state (4,) is."""
        return rng.uniform(self.low, self.high)


_ONES = np.ones(len(STATE_NAMES))
ACTIONS = FetchActions(
    STATE_NAMES, -_ONES, _ONES, np.array([1.0, 1.0, 1.0, 2.0]), np.array([True, True, True, False])
)


class FetchEnv(PackagedEnv):
    """An environment of gymnasium-robotics.

    Args:
        task: The environment's name there.
        cameras: Not used, as no camera draws these environments.
    """

    robot = "fetch_stock"
    action_meaning = (
        "displacement of the gripper in x, y, z [5 cm], fingers from -1 (close) to 1 (open)"
    )
    control_hz, horizon = 25, 50
    actions = ACTIONS

    def __init__(self, task: str, cameras: CameraConfig | None = None):
        self.task = FETCH_TASKS[task]
        # gymnasium-robotics announces its versions there
        with contextlib.redirect_stderr(io.StringIO()):
            import_module("gymnasium_robotics")  # which registers its names
            # the horizon is its time limit
            self._env: Any = gymnasium.make(task, reward_type="sparse").unwrapped
        self.model = self._env.model
        self.data = self._env.data
        self._env._mujoco_step = self._run_physics
        self.start(0)

    @override
    def observed_names(self) -> tuple[str, ...]:
        things = ("object", "object_offset") if self.task.has_object else ()
        turning = ("object_turn", "object_velocity", "object_spin") if self.task.has_object else ()
        fingers = ("finger.right", "finger.left")
        speeds = [f"{name}.velocity" for name in fingers]
        names = (
            *coordinates("ee", *things),
            *fingers,
            *coordinates(*turning, "ee_velocity"),
            *speeds,
        )
        return (*names, *coordinates("goal"))

    @override
    def start(self, seed: int) -> None:
        super().start(seed)
        self._remember()

    @override
    def step(self, action: NDArray[Any]) -> Outcome:
        outcome = super().step(action)
        # with closed fingers, the environment's step has recomputed all poses
        if self.task.blocked:
            self._remember()
        return outcome

    @property
    @override
    def progress(self) -> float:
        """Share of the task that is done: 1 within the tolerance, 0.5 at twice that distance."""
        left = np.linalg.norm(
            self.positions()["object" if self.task.has_object else "hand"] - self.goal
        )
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
        return sum(
            float(self.data.joint(f"robot0:{side}_gripper_finger_joint").qpos[0]) for side in "rl"
        )

    @property
    def goal(self) -> F64:
        """Desired goal, (3,) [m]."""
        return self._env.goal

    @override
    def observe(self) -> Observation:
        """Return the gripper's position and opening, (4,) [m], and the environment's own
        observation and goal, (k,).
        """
        own = self._env._get_obs()
        state = np.append(own["observation"][:3], self.opening).astype(np.float32)
        return Observation(
            state, np.append(own["observation"], own["desired_goal"]).astype(np.float32)
        )

    @override
    def get_state(self) -> State:
        """Return MuJoCo's state, what the poses are computed from, and the goal as `variation`."""
        state = super().get_state()
        return replace(
            state, physics=np.concatenate([state.physics, self._posed]), variation=self.goal.copy()
        )

    @override
    def set_state(self, state: State) -> None:
        size, nq = mujoco.mj_stateSize(self.model, WHOLE), self.model.nq
        self._restore(state, size + len(self._posed))
        physics, self._posed = state.physics[:size].copy(), state.physics[size:].copy()
        mujoco.mj_setState(self.model, self.data, physics, WHOLE)
        self.data.qpos[:] = self._posed[:nq]
        self.data.qvel[:] = self._posed[nq:]
        mujoco.mj_fwdPosition(self.model, self.data)
        mujoco.mj_fwdVelocity(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, physics, WHOLE)
        self._env.goal = state.variation.copy()

    @override
    def positions(self) -> dict[str, F64]:
        return {"hand": self.gripper} | ({"object": self.object} if self.task.has_object else {})

    def _remember(self) -> None:
        """Store the positions and velocities that the poses are computed from."""
        self._posed = np.concatenate([self.data.qpos, self.data.qvel])

    def _run_physics(self, action: NDArray[Any]) -> None:
        """Run the environment's physics steps in two calls, to store the state before the last
        one.
        """
        mujoco.mj_step(self.model, self.data, nstep=self._env.n_substeps - 1)
        self._remember()
        mujoco.mj_step(self.model, self.data, nstep=1)
