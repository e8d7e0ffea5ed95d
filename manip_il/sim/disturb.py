"""Disturbances: what happens to an environment that no action of the learner's asked for.

Each function changes the simulator in place and draws from the generator that it is given.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UsageError
from manip_il.seeding import rng_for
from manip_il.sim.conditions import Circumstances
from manip_il.sim.env import ManipEnv
from manip_il.sim.task import in_reach
from manip_il.sim.world import CUBE_HALF_SIZE

F64 = NDArray[np.float64]
_MAX_DRAWS = 100
_OVERLAP = -0.004  # contact distance at which a moved object stands inside something [m]


@dataclass(frozen=True)
class Disturbance:
    """What an episode has to stand.

    action_noise: standard deviation of Gaussian noise on every executed action, as a share of the action's
    full range (twice the longest joint step; the whole opening), as in Meta-World's tests of its scripted
    policies. knock: range of distances that the object is knocked by once [m]; knock_steps: range of the
    control steps at which it happens.
    """

    action_noise: float = 0.0
    knock: tuple[float, float] | None = None
    knock_steps: tuple[int, int] = (5, 25)

    def __post_init__(self) -> None:
        if not 0 <= self.action_noise <= 1:
            raise UsageError(f"action_noise is {self.action_noise}; expected 0 to 1")


NONE = Disturbance()
STANDARD = Disturbance(action_noise=0.1, knock=(0.05, 0.08))


def noisy(action: F64, env: ManipEnv, share: float, rng: np.random.Generator) -> F64:
    """`action` (n,) with Gaussian noise of `share` of its range."""
    robot = env.scene.robot
    spread = np.full(len(action), 2 * robot.max_joint_step)
    spread[-1] = robot.max_opening
    return action + rng.normal(0.0, share, len(action)) * spread


def knock_object(env: ManipEnv, rng: np.random.Generator, distance: tuple[float, float]) -> bool:
    """Move the object sideways by a drawn distance [m], at rest, to where the arm reaches it and nothing stands.

    Returns whether there was an object and such a place.
    """
    return _move_object(env, rng, distance, height=0.0)


def drop_object(env: ManipEnv, rng: np.random.Generator, distance: tuple[float, float], height: float) -> bool:
    """Move the object sideways by a drawn distance and up by `height` [m], turned at random, to fall."""
    return _move_object(env, rng, distance, height)


def jolt_joints(env: ManipEnv, rng: np.random.Generator, largest: float) -> bool:
    """Turn every arm joint by up to `largest` [rad]; an object between the fingers moves with the hand.

    Draws in which something would stand inside something else are drawn again; returns whether one was found.
    """
    scene, data = env.scene, env.data
    low, high = scene.arm_range.T
    before = data.qpos.copy()
    for _ in range(_MAX_DRAWS):
        q = before[scene.arm_q] + rng.uniform(-largest, largest, len(scene.arm_q))
        data.qpos[scene.arm_q] = np.clip(q, low, high)
        _carry_along(env, before)
        data.qvel[:] = 0.0
        mujoco.mj_forward(scene.model, data)
        if all(contact.dist > _OVERLAP for contact in data.contact):
            return True
    data.qpos[:] = before
    mujoco.mj_forward(scene.model, data)
    return False


def set_fingers(env: ManipEnv, opening: float) -> None:
    """Command an opening [m] and put the gripper there, unless the object is in the way."""
    scene, data = env.scene, env.data
    before = data.qpos[scene.finger_q].copy()
    data.qpos[scene.finger_q] = data.ctrl[scene.finger_ctrl] = opening / 2
    mujoco.mj_forward(scene.model, data)
    if any(contact.dist <= _OVERLAP for contact in data.contact):
        data.qpos[scene.finger_q] = before
        mujoco.mj_forward(scene.model, data)


def _carry_along(env: ManipEnv, before: F64) -> None:
    """Give an object between the fingers the motion of the hand from `before` (qpos) to now."""
    scene, data = env.scene, env.data
    if scene.object_q is None:
        return
    at = slice(scene.object_q, scene.object_q + 7)
    now = data.qpos.copy()
    data.qpos[:] = before
    mujoco.mj_kinematics(scene.model, data)
    ee, rotation = data.site_xpos[scene.ee_site].copy(), data.site_xmat[scene.ee_site].reshape(3, 3).copy()
    data.qpos[:] = now
    offset = rotation.T @ (before[at][:3] - ee)
    if np.abs(offset).max() > CUBE_HALF_SIZE:
        data.qpos[at] = before[at]
        return
    mujoco.mj_kinematics(scene.model, data)
    turned = data.site_xmat[scene.ee_site].reshape(3, 3)
    data.qpos[at][:3] = data.site_xpos[scene.ee_site] + turned @ offset
    turn, quat = np.empty(4), np.empty(4)
    mujoco.mju_mat2Quat(turn, (turned @ rotation.T).ravel())
    mujoco.mju_mulQuat(quat, turn, before[at][3:])
    data.qpos[at][3:] = quat


def _move_object(env: ManipEnv, rng: np.random.Generator, distance: tuple[float, float], height: float) -> bool:
    scene, data = env.scene, env.data
    if scene.object_q is None or scene.object_v is None:
        return False
    start = data.qpos[scene.object_q : scene.object_q + 7].copy()
    half = float(scene.model.geom("object").size[2])
    for _ in range(_MAX_DRAWS):
        angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(*distance)
        pose = start.copy()
        pose[:2] += length * np.array([np.cos(angle), np.sin(angle)])
        pose[2] = max(pose[2] + height, half)
        if height > 0:
            turn = rng.normal(size=4)
            pose[3:] = turn / np.linalg.norm(turn)
        landing = np.array([*pose[:2], half])
        if in_reach(scene.robot, landing) and _on_table(env, pose) and _place(env, pose):
            return True
    _place(env, start)
    return False


def _on_table(env: ManipEnv, pose: F64) -> bool:
    table = env.scene.model.geom("table")
    return bool(np.all(np.abs(pose[:2] - table.pos[:2]) < table.size[:2] - 0.05))


def _place(env: ManipEnv, pose: F64) -> bool:
    """Put the object at rest at `pose` (7,); false where it would stand inside something."""
    scene, data = env.scene, env.data
    assert scene.object_q is not None
    assert scene.object_v is not None
    data.qpos[scene.object_q : scene.object_q + 7] = pose
    data.qvel[scene.object_v : scene.object_v + 6] = 0.0
    mujoco.mj_forward(scene.model, data)
    cube = scene.model.geom("object").id
    return all(contact.dist > _OVERLAP for contact in data.contact if cube in (contact.geom1, contact.geom2))


def disturbance_of(circumstances: Circumstances) -> Disturbance:
    """The part of an episode's circumstances that knocks its object and makes its actions noisy."""
    noise = circumstances.number("action_noise")
    if "knock" not in circumstances.drawn:
        return Disturbance(noise)
    distance, step = circumstances.number("knock"), int(circumstances.number("knock_step"))
    return Disturbance(noise, (distance, distance), (step, step + 1))


class Disturber:
    """One episode's disturbances, drawn from its seed."""

    def __init__(self, env: ManipEnv, disturbance: Disturbance, seed: int):
        self._env, self._disturbance = env, disturbance
        self._noise, self._knock = rng_for(seed, "action noise"), rng_for(seed, "knock")
        self._knock_at = int(self._knock.integers(*disturbance.knock_steps)) if disturbance.knock else -1

    def before(self, step: int) -> None:
        """Knock the object, where this is the step for it."""
        if step == self._knock_at and self._disturbance.knock is not None:
            knock_object(self._env, self._knock, self._disturbance.knock)

    def action(self, action: F64) -> F64:
        """The action as it reaches the robot."""
        share = self._disturbance.action_noise
        return noisy(action, self._env, share, self._noise) if share else action
