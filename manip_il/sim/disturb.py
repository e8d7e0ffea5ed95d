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
from manip_il.sim.world import World

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
    actions = env.scene.actions
    spread = np.where(actions.relative, 2, 1) * actions.scale
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
    scene, world, data = env.scene, env.world, env.data
    low, high = scene.actions.low[scene.actions.arm], scene.actions.high[scene.actions.arm]
    before = data.qpos.copy()
    for _ in range(_MAX_DRAWS):
        q = before[scene.arm_q] + rng.uniform(-largest, largest, len(scene.arm_q))
        _carry_along(world, before, np.clip(q, low, high))
        data.qvel[:] = 0.0
        _settle(world)
        if all(contact.dist > _OVERLAP for contact in data.contact):
            return True
    data.qpos[:] = before
    _settle(world)
    return False


def set_fingers(env: ManipEnv, opening: float) -> None:
    """Command an opening [m] and put the gripper there, unless the object is in the way."""
    gripper, data = env.scene.gripper, env.data
    before = data.qpos[gripper.q].copy()
    data.qpos[gripper.q] = data.ctrl[gripper.ctrl] = gripper.command(opening)
    _settle(env.world)
    if any(contact.dist <= _OVERLAP for contact in data.contact):
        data.qpos[gripper.q] = before
        _settle(env.world)


def _settle(world: World) -> None:
    """Bring everything that follows from positions up to date, contacts too."""
    world.moved()
    mujoco.mj_forward(world.model, world.data)


def _carry_along(world: World, before: F64, q: F64) -> None:
    """Put the arm at `q` [rad], and what was between the fingers at `before` (qpos) with it."""
    scene, data = world.scene, world.data
    data.qpos[:] = before
    world.moved()
    ee, rotation = world.ee.position.copy(), world.ee.rotation.copy()
    held = [
        one
        for one in scene.objects.values()
        if np.abs(rotation.T @ (before[one.q : one.q + 3] - ee)).max() <= max(world.extents(one.name)) / 2
    ]
    data.qpos[scene.arm_q] = q
    world.moved()
    turned = world.ee.rotation
    for one in held:
        start = before[one.q : one.q + 7]
        turn, quat = np.empty(4), np.empty(4)
        mujoco.mju_mat2Quat(turn, (turned @ rotation.T).ravel())
        mujoco.mju_mulQuat(quat, turn, start[3:])
        at = world.ee.position + turned @ (rotation.T @ (start[:3] - ee))
        data.qpos[one.q : one.q + 7] = [*at, *quat]


def _move_object(env: ManipEnv, rng: np.random.Generator, distance: tuple[float, float], height: float) -> bool:
    """Move the first of the objects that the hand grasps."""
    if not env.scene.task.grasped:
        return False
    name = env.scene.task.grasped[0]
    one, world = env.scene.objects[name], env.world
    start, half = world.data.qpos[one.q : one.q + 7].copy(), world.extents(name)[2] / 2
    for _ in range(_MAX_DRAWS):
        angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(*distance)
        pose = start.copy()
        pose[:2] += length * np.array([np.cos(angle), np.sin(angle)])
        pose[2] = max(pose[2] + height, half)
        if height > 0:
            turn = rng.normal(size=4)
            pose[3:] = turn / np.linalg.norm(turn)
        landing = np.array([*pose[:2], half])
        if world.reach.has(landing) and _on_table(env, pose) and _place(world, name, pose):
            return True
    _place(world, name, start)
    return False


def _on_table(env: ManipEnv, pose: F64) -> bool:
    table = env.scene.model.geom("table")
    return bool(np.all(np.abs(pose[:2] - table.pos[:2]) < table.size[:2] - 0.05))


def _place(world: World, name: str, pose: F64) -> bool:
    """Put an object at rest at `pose` (7,); false where it would stand inside something."""
    world.place(name, pose[:3], pose[3:])
    _settle(world)
    geom = world.scene.objects[name].geom
    return all(contact.dist > _OVERLAP for contact in world.data.contact if geom in (contact.geom1, contact.geom2))


def disturbance_of(circumstances: Circumstances) -> Disturbance:
    """Return the part of an episode's circumstances that knocks its object and makes its actions noisy."""
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
        """Return the action as it reaches the robot."""
        share = self._disturbance.action_noise
        return noisy(action, self._env, share, self._noise) if share else action
