"""A motion of an arm that tells its servos apart: jumps, swings and slow reversals, clear of the
table and of itself.
"""

import mujoco
import numpy as np

from manip_il.errors import UsageError
from manip_il.mdp import F64
from manip_il.sim.events import arm_contacts
from manip_il.sim.world import Scene, World

SEGMENT = 3.0  # time between drawn postures [s]
_EDGE = 0.15  # distance from the joints' limits [rad]
_FAR = 1.2  # longest way of a joint between two postures [rad]
_OVER = 0.12  # how far a joint may overshoot [rad]
_HIGH = 0.06  # least height of the hand over the table [m]
_LOOKS = 40  # postures between two others that are looked at
_DRAWS, _TRIES = 10_000, 20  # of first postures, of ways to the next
_NEARER = 0.7  # share of a way that remains if something is in it
_SLOW = 0.3  # longest way of a slow reversal [rad]
_SWINGS = 0.3, 1.2  # frequencies of swings [Hz]


def excite(scene: Scene, fps: float, seconds: float, rng: np.random.Generator) -> F64:
    """Draw a motion.

    Every `SEGMENT` a posture is drawn, and every joint jumps there, swings in between, or slowly
    goes some way there and back. Of random postures between the two none touches anything, as the
    joints arrive in any order.

    Args:
        scene: A scene of an arm with servos, without objects.
        fps: Frames per second.
        seconds: Length of the motion [s].
        rng: Generator to draw from.

    Returns:
        Goals at every frame, joint angles [rad], (T, n).

    Raises:
        UsageError: If the arm has no servos, or no posture is found that is clear.
    """
    if scene.robot.lerobot is None:
        raise UsageError(f"{scene.robot.name} has no servos; expected so101 or an arm like it")
    world = World(scene)
    q = np.append(scene.arm_q, scene.gripper.q)
    arm = scene.model.jnt_range[np.isin(scene.model.jnt_qposadr, scene.arm_q)]
    low, high = np.array([*arm, sorted(scene.robot.lerobot.gripper)]).T + [[_EDGE], [-_EDGE]]
    world.data.qpos[scene.arm_q] = scene.robot.home
    before = _contacts(world)

    def is_clear(one: F64, other: F64) -> bool:
        ends = np.minimum(one, other) - _OVER, np.maximum(one, other) + _OVER
        for posture in rng.uniform(*ends, (_LOOKS, len(q))):
            world.data.qpos[q] = posture
            if not _contacts(world) <= before or world.ee.position[2] < _HIGH:
                return False
        return True

    frames = round(SEGMENT * fps)
    time = np.arange(1, frames + 1)[:, None] / fps
    for _ in range(_DRAWS):
        if is_clear(at := rng.uniform(low, high), at):
            break
    else:
        raise UsageError(f"{scene.robot.name} has no posture clear of the table and of itself")
    goals, last = [at[None]], at
    while len(goals) * SEGMENT <= seconds:
        to = np.clip(rng.uniform(low, high), at - _FAR, at + _FAR)
        for _ in range(_TRIES):
            if is_clear(at, to):
                break
            to = at + _NEARER * (to - at)
        else:
            to = last  # back where it came from
        way, kind = to - at, rng.integers(3, size=len(q))
        jump = np.where(time < rng.uniform(0, SEGMENT / 2, len(q)), at, to)
        turns = rng.uniform(*_SWINGS, len(q)) * time + rng.uniform(0, 1, len(q))
        swing = at + way * (0.5 + 0.5 * np.sin(2 * np.pi * turns))
        slow = at + np.clip(way, -_SLOW, _SLOW) * (1 - np.abs(2 * time / SEGMENT - 1))
        goals.append(np.choose(kind, [jump, swing, slow]))
        last, at = at, goals[-1][-1]
    return np.concatenate(goals)


def _contacts(world: World) -> set[tuple[int, int, bool]]:
    world.update()
    mujoco.mj_collision(world.model, world.data)
    return arm_contacts(world)
