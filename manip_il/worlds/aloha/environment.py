"""The environments of `gym_aloha`, unmodified, as a world."""

from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from typing import Any, override

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.caching import cached_per_thread
from manip_il.errors import RenderError, requires
from manip_il.mdp import F64, Label, State
from manip_il.robots.action_space import ActionSpace
from manip_il.sim.config import CameraConfig
from manip_il.sim.render import LOOK_VERSION as DRAWN
from manip_il.sim.render import REMEDY
from manip_il.sim.view import simplify_meshes
from manip_il.worlds.aloha.expert import ArmExpert, label
from manip_il.worlds.aloha.insertion import Insertion
from manip_il.worlds.aloha.ladder import SIDES, AlohaScene, phases, read_hand
from manip_il.worlds.aloha.transfer import Transfer
from manip_il.worlds.config import WORLDS
from manip_il.worlds.contract import GRIPPERS as GRIPPERS_OF
from manip_il.worlds.contract import TWO_ARMS, EnvironmentSpec, Outcome
from manip_il.worlds.gym.environment import GymEnv, GymKind, coordinates
from manip_il.worlds.gym.restoring import WHOLE, physics_of
from manip_il.worlds.gym.world import AGENT, AROUND, GymWorld

ALOHA_TASKS = {task.name: task for task in (Transfer, Insertion)}
_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
# as in `lerobot/aloha_sim_*`
NAMES = tuple(f"{side}_{joint}" for side in SIDES for joint in _JOINTS)
INSTALL = "--no-deps gym-aloha==0.1.5 dm-control==1.0.44 dm-env==1.6 dm-tree==0.1.10 lxml==6.1.3"
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


class Aloha(GymWorld):
    """One task of `gym_aloha`; its `step` and `reset` return an empty observation.

    Args:
        task: A key of `ALOHA_TASKS`.

    Attributes:
        about: The task, whose scenes are read from its states.
    """

    name = "aloha"
    tasks = tuple(ALOHA_TASKS)
    # as in LeRobot's environment; the one registered with gymnasium has 300 steps
    fps = 50
    horizon = 400
    cameras = WORLDS["aloha"].cameras

    @override
    def make(self) -> Any:
        self.about = ALOHA_TASKS[self.task]
        self.instruction = self.about.instruction
        self.phases = phases(self.about)
        with requires("aloha", INSTALL):
            env = import_module("gym_aloha.env").AlohaEnv(self.about.own)
        self.physics, self._task = env._env.physics, env._env.task
        self.model, self.data = self.physics.model.ptr, self.physics.data.ptr
        # it would draw three pictures in every step, whatever is observed
        self._task.get_observation = lambda _: None
        env._format_raw_obs = lambda _: np.empty(0)
        env.action_space = gymnasium.spaces.Box(*_bounds(self.model), dtype=np.float64)
        self._arms = {
            side: ArmExpert(self.model, number, side) for number, side in enumerate(SIDES)
        }
        around = (
            coordinates(name) if np.ndim(value) else (name,)
            for name, value in self.scene().observed().items()
        )
        self.names = {AGENT: NAMES, AROUND: sum(around, ()), "action": NAMES}
        return env

    @override
    def observe(self, env: Any, seen: F64) -> dict[str, F64]:
        """Return joint positions and gripper openings, (14,), and the scene's numbers, (k,)."""
        numbers = np.hstack([*self.scene().observed().values()])
        return {AGENT: self.measured(), AROUND: numbers}

    @override
    def act(self, env: Any, seen: F64) -> Label:
        found = label(self.scene(), self._arms, self.data.qfrc_bias)
        if isinstance(found, Label):
            return found
        return Label(self.measured(), 0, False, 1.0, found)

    @override
    def progress(self, env: Any, info: Mapping[str, Any]) -> float:
        """Return the reward of the state as a share of the environment's highest reward."""
        return float(self._task.get_reward(self.physics)) / MOST_REWARD

    @override
    def positions(self, env: Any) -> dict[str, F64]:
        """Return the positions (3,) [m] of the right hand and the objects, the first of which is
        `object`.
        """
        scene = self.scene()
        names = ["object", *list(scene.things)[1:]]
        things = zip(names, scene.things.values(), strict=True)
        return {"hand": scene.right.position} | {name: thing.position for name, thing in things}

    @override
    def render(self, env: Any, camera: str, cameras: CameraConfig) -> NDArray[np.uint8]:
        painter = _painter(self.task, fine=cameras.height > _COARSE)
        painter.restore(None, self.state(env))
        try:
            return painter.physics.render(cameras.height, cameras.width, camera)
        except Exception as error:  # what OpenGL and its bindings raise
            raise RenderError(f"{self.name} cannot be rendered ({error}); {REMEDY}") from error

    @override
    def state(self, env: Any) -> F64:
        """Return MuJoCo's integration state, (p,): after a step, all poses are up to date."""
        return physics_of(self.model, self.data)

    @override
    def restore(self, env: Any, state: F64) -> None:
        mujoco.mj_setState(self.model, self.data, state, WHOLE)
        mujoco.mj_forward(self.model, self.data)

    def scene(self) -> AlohaScene:
        """Return the scene read from the state."""
        return self.about(self.model, self.data)

    def measured(self) -> F64:
        """Return joint positions [rad] and gripper openings, 0 to 1, (14,)."""
        return self._task.get_qpos(self.physics)


class AlohaEnv(GymEnv):
    """An environment of `gym_aloha` behind the contract, of which new scenes can be made."""

    world: Aloha
    hashes_code = False

    @override
    def step(self, action: NDArray[Any]) -> Outcome:
        return super().step(action)._replace(ended=False)  # `ends_solved`, as the caller asks

    @override
    def _found_actions(self) -> ActionSpace:
        found = super()._found_actions()
        is_joint = np.ones(len(found), bool)
        is_joint[GRIPPERS] = False
        return replace(found, scale=np.where(is_joint, LONGEST, 1.0), relative=is_joint)

    @override
    def _described(self, horizon: int) -> EnvironmentSpec:
        found = super()._described(horizon)
        return replace(
            found,
            action_meaning=TWO_ARMS,
            state_names=(),
            can=(*found.can, "redrawn"),
            drawing_version=DRAWN,
        )

    @override
    def redrawn(self, state: State, rng: np.random.Generator) -> State | None:
        """Return `state` with some arms and some untouched objects on the table moved at random.

        An object in a hand moves with the hand, or is dropped first. Return None if bodies then
        overlap.
        """
        self.set_state(state)
        model, data = self.world.model, self.world.data
        self.env.reset(seed=int(rng.integers(2**32)))
        fresh = data.qpos.copy()
        self.set_state(state)
        if rng.random() < 2 * _DROPPED:
            self._drop(rng)
        scene = self.world.scene()
        holders = {
            name: [side for side in scene.hands if any(scene.touches(side, name))]
            for name in self.world.about.objects
        }
        for name, sides in holders.items():
            if not sides and scene.on_table(name) and rng.random() < _ANEW:
                at, speed = _free(model, name)
                data.qpos[at : at + 2] = fresh[at : at + 2]
                data.qvel[speed : speed + 6] = 0
        for number, (side, hand) in enumerate(scene.hands.items()):
            held = [name for name, sides in holders.items() if side in sides]
            if rng.random() < _STAYS or any(
                len(holders[name]) > 1 or scene.on_table(name) for name in held
            ):
                continue
            data.qpos[8 * number : 8 * number + 6] += rng.normal(
                0.0, _ELSEWHERE * rng.uniform() ** 2, 6
            )
            mujoco.mj_kinematics(model, data)
            moved = read_hand(side, number, data)
            turn = moved.rotation @ hand.rotation.T
            for name in held:
                at, _ = _free(model, name)
                data.qpos[at : at + 3] = moved.position + turn @ (
                    scene.things[name].position - hand.position
                )
                quat = np.empty(4)
                mujoco.mju_mat2Quat(quat, (turn @ scene.things[name].axes).ravel())
                data.qpos[at + 3 : at + 7] = quat
        mujoco.mj_forward(model, data)
        if (data.contact.dist < -_DEEP).any():
            return None
        return replace(state, physics=physics_of(model, data))

    def _drop(self, rng: np.random.Generator) -> None:
        """Pick a hand.

        If it holds something in the air, open it and simulate some control steps.
        """
        scene, number = self.world.scene(), int(rng.integers(2))
        hand = list(scene.hands)[number]
        if any(
            all(scene.touches(hand, name)) and not scene.on_table(name)
            for name in self.world.about.objects
        ):
            action = self.world.measured()
            action[GRIPPERS[number]] = 1.0
            for _ in range(rng.integers(1, _FALL)):
                self.step(action)


class AlohaKind(GymKind):
    """The tasks of `gym_aloha`, which LeRobot's evaluator also runs."""

    @override
    def lerobot_words(self, robot: str, task: str) -> list[str]:
        return ["--env.type=aloha", f"--env.task={task}", "--eval.batch_size=1"]


WORLD = AlohaKind(Aloha, AlohaEnv)


def _free(model: mujoco.MjModel, name: str) -> tuple[int, int]:
    """Addresses of an object's pose in `qpos` and of its velocity in `qvel`."""
    joint = model.body(name).jntadr[0]
    return int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])


@cached_per_thread()
def _painter(task: str, *, fine: bool) -> Aloha:
    """The world that draws a task's states in this thread, so that one OpenGL context is
    enough.

    Unless `fine`, its meshes have fewer faces and its shadows are coarser, which is 3.5 times
    faster in software.
    """
    painter = Aloha(task)
    painter.make()
    if not fine:
        simplify_meshes(painter.model, _CELL)
        painter.model.vis.quality.shadowsize = _SHADOWS
    return painter


def _bounds(model: mujoco.MjModel) -> tuple[F64, F64]:
    """Return the actuators' own bounds, which MuJoCo enforces, (14,) each.

    The environment's -1 to 1 does not apply.
    """
    # a hand's right finger mirrors the left one
    low, high = model.actuator_ctrlrange[[*range(7), *range(8, 15)]].T.copy()
    low[GRIPPERS], high[GRIPPERS] = 0.0, 1.0
    return low, high
