"""One environment of `gym_aloha`, unmodified, behind the contract of a world."""

from dataclasses import replace
from importlib import import_module
from typing import Any, override

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.caching import cached_per_thread
from manip_il.errors import ManipError, RenderError
from manip_il.mdp import F64, Observation, State
from manip_il.robots.action_space import ActionSpace
from manip_il.sim.config import CameraConfig
from manip_il.sim.render import REMEDY
from manip_il.sim.view import simplify_meshes
from manip_il.worlds.aloha import insertion, transfer
from manip_il.worlds.aloha.ladder import SIDES, AlohaScene, read_hand
from manip_il.worlds.contract import GRIPPERS as GRIPPERS_OF
from manip_il.worlds.contract import TWO_ARMS
from manip_il.worlds.packaged import WHOLE, PackagedEnv, coordinates

ALOHA_TASKS = {one.TASK.name: one.TASK for one in (transfer, insertion)}
_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
# as in `lerobot/aloha_sim_*`
ALOHA_NAMES = tuple(f"{side}_{joint}" for side in SIDES for joint in _JOINTS)
INSTALL = (
    "pip install --no-deps gym-aloha==0.1.5 dm-control==1.0.44 dm-env==1.6 dm-tree==0.1.10"
    " lxml==6.1.3"
)
MOST_REWARD = 4
GRIPPERS = np.array(GRIPPERS_OF[TWO_ARMS])
LONGEST = 0.04  # longest step of a joint, as for the expert [rad]
_DEEP = 4e-3  # tolerated overlap in a redrawn scene [m]
# chance that an untouched object gets a new place; otherwise a hand reaching for it stays near it
_ANEW = 0.6
# chance that a hand drops what it carries; most control steps after it has opened
_DROPPED, _FALL = 0.1, 30
# chance that an arm stays; largest standard deviation of its joints if not [rad]
_STAYS, _ELSEWHERE = 0.4, 0.08
# picture height up to which meshes are simplified [pixels]; 2 % of pixels change by over 8 of 255
_COARSE = 240
# least cell size of simplified meshes [m]; size of the shadow map [pixels]
_CELL, _SHADOWS = 0.004, 1024
_BLANK = np.zeros((1, 1, 3), np.uint8)


class AlohaActions(ActionSpace):
    """Joint targets [rad] and gripper commands, 0 to 1, of two arms."""

    def random_near(self, state: NDArray[np.floating], rng: np.random.Generator) -> F64:
        """Draw joint targets near the measured joints in `state` (14,), the grippers anywhere."""
        action = np.asarray(state, np.float64) + rng.uniform(-LONGEST, LONGEST, len(self))
        action[GRIPPERS] = rng.uniform(0.0, 1.0, len(GRIPPERS))
        return action


class AlohaEnv(PackagedEnv):
    """An environment of `gym_aloha`.

    Args:
        task: A key of `ALOHA_TASKS`.
        cameras: Cameras rendered in every step; None for none.

    Raises:
        ManipError: if the package is not installed.
    """

    robot, action_meaning = "aloha", TWO_ARMS
    # as in LeRobot's environment; the one registered with gymnasium has 300 steps
    control_hz, horizon = 50, 400
    can = ("restored", "redrawn", "drawn")
    ends_solved = True

    def __init__(self, task: str, cameras: CameraConfig | None = None):
        self.task, self._cameras = ALOHA_TASKS[task], cameras
        self._env = _gym_aloha().AlohaEnv(self.task.own, obs_type="pixels_agent_pos")
        self.physics = self._env._env.physics
        self.draw = self.physics.render
        # it would draw three pictures in every step, whatever is observed
        self.physics.render = lambda **_: _BLANK
        self.model, self.data = self.physics.model.ptr, self.physics.data.ptr
        self.actions = _actions(self.model)
        self.start(0)

    @override
    def start(self, seed: int) -> None:
        super().start(seed % 2**32)  # gym_aloha takes no larger seed

    @property
    @override
    def progress(self) -> float:
        """Reward of the state as a share of the environment's highest reward."""
        return float(self._env._env.task.get_reward(self.physics)) / MOST_REWARD

    def scene(self) -> AlohaScene:
        """Return the scene read from the state."""
        return self.task.scene(self.task, self.model, self.data)

    def measured(self) -> F64:
        """Return joint positions [rad] and gripper openings, 0 to 1, (14,)."""
        return self._env._env.task.get_qpos(self.physics)

    @override
    def observed_names(self) -> tuple[str, ...]:
        found = self.scene().observed().items()
        return tuple(
            one
            for name, value in found
            for one in (coordinates(name) if np.ndim(value) else (name,))
        )

    @override
    def observe(self) -> Observation:
        """Return joint positions and gripper openings, (14,), the scene's `environment_state`,
        (k,), and pictures.
        """
        numbers = np.hstack([*self.scene().observed().values()])
        pictures = self._pictures(self._cameras) if self._cameras else {}
        return Observation(self.measured().astype(np.float32), numbers.astype(np.float32), pictures)

    @override
    def set_state(self, state: State) -> None:
        self._restore(state, mujoco.mj_stateSize(self.model, WHOLE))
        mujoco.mj_setState(self.model, self.data, state.physics, WHOLE)
        mujoco.mj_forward(self.model, self.data)

    @override
    def positions(self) -> dict[str, F64]:
        """Return the positions (3,) [m] of the right hand and the objects, the first of which is
        `object`.
        """
        scene = self.scene()
        names = ["object", *list(scene.things)[1:]]
        things = zip(names, scene.things.values(), strict=True)
        return {"hand": scene.right.position} | {name: thing.position for name, thing in things}

    @override
    def redrawn(self, state: State, rng: np.random.Generator) -> State | None:
        """Return `state` with some arms and some untouched objects on the table moved at random.

        An object in a hand moves with the hand, or is dropped first. Return None if bodies then
        overlap.
        """
        self.set_state(state)
        self._env.reset(seed=int(rng.integers(2**32)))
        fresh = self.data.qpos.copy()
        self.set_state(state)
        if rng.random() < 2 * _DROPPED:
            self._drop(rng)
        scene = self.scene()
        holders = {
            name: [side for side in scene.hands if any(scene.touches(side, name))]
            for name in self.task.objects
        }
        for name, sides in holders.items():
            if not sides and scene.on_table(name) and rng.random() < _ANEW:
                at, speed = self._free(name)
                self.data.qpos[at : at + 2] = fresh[at : at + 2]
                self.data.qvel[speed : speed + 6] = 0
        for number, (side, hand) in enumerate(scene.hands.items()):
            held = [name for name, sides in holders.items() if side in sides]
            if rng.random() < _STAYS or any(
                len(holders[name]) > 1 or scene.on_table(name) for name in held
            ):
                continue
            self.data.qpos[8 * number : 8 * number + 6] += rng.normal(
                0.0, _ELSEWHERE * rng.uniform() ** 2, 6
            )
            mujoco.mj_kinematics(self.model, self.data)
            moved = read_hand(side, number, self.data)
            turn = moved.rotation @ hand.rotation.T
            for name in held:
                at, _ = self._free(name)
                self.data.qpos[at : at + 3] = moved.position + turn @ (
                    scene.things[name].position - hand.position
                )
                quat = np.empty(4)
                mujoco.mju_mat2Quat(quat, (turn @ scene.things[name].axes).ravel())
                self.data.qpos[at + 3 : at + 7] = quat
        mujoco.mj_forward(self.model, self.data)
        if (self.data.contact.dist < -_DEEP).any():
            return None
        return replace(state, physics=self._physics())

    def _drop(self, rng: np.random.Generator) -> None:
        """Pick a hand.

        If it holds something in the air, open it and simulate some control steps.
        """
        scene, number = self.scene(), int(rng.integers(2))
        hand = list(scene.hands)[number]
        if any(
            all(scene.touches(hand, name)) and not scene.on_table(name)
            for name in self.task.objects
        ):
            action = self.measured()
            action[GRIPPERS[number]] = 1.0
            for _ in range(rng.integers(1, _FALL)):
                self.step(action)

    def _free(self, name: str) -> tuple[int, int]:
        """Addresses of an object's pose in `qpos` and of its velocity in `qvel`."""
        joint = self.model.body(name).jntadr[0]
        return int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])

    def _pictures(self, cameras: CameraConfig) -> dict[str, NDArray[np.uint8]]:
        height, width = cameras.size
        painter = _painter(self.task.name, fine=height > _COARSE)
        painter.set_state(self.get_state())
        try:
            return {
                name: painter.draw(height=height, width=width, camera_id=name)
                for name in cameras.names
            }
        except Exception as error:  # what OpenGL and its bindings raise
            raise RenderError(f"{self.robot} cannot be rendered ({error}); {REMEDY}") from error


@cached_per_thread()
def _painter(task: str, *, fine: bool) -> AlohaEnv:
    """The environment that draws a task's states in this thread, so that one OpenGL context is
    enough.

    Unless `fine`, its meshes have fewer faces and its shadows are coarser, which is 3.5 times
    faster in software.
    """
    painter = AlohaEnv(task)
    if not fine:
        simplify_meshes(painter.model, _CELL)
        painter.model.vis.quality.shadowsize = _SHADOWS
    return painter


def _gym_aloha() -> Any:
    try:
        return import_module("gym_aloha.env")
    except ModuleNotFoundError as error:
        raise ManipError(
            f"{AlohaEnv.robot} needs {error.name}, which is not installed: {INSTALL}"
        ) from error


def _actions(model: mujoco.MjModel) -> ActionSpace:
    """Actions within the actuators' own bounds, which MuJoCo enforces.

    The environment's -1 to 1 does not apply.
    """
    chosen = [*range(7), *range(8, 15)]  # a hand's right finger mirrors the left one
    low, high = model.actuator_ctrlrange[chosen].T.copy()
    low[GRIPPERS], high[GRIPPERS] = 0.0, 1.0
    is_joint = np.ones(len(chosen), bool)
    is_joint[GRIPPERS] = False
    return AlohaActions(ALOHA_NAMES, low, high, np.where(is_joint, LONGEST, 1.0), is_joint)
