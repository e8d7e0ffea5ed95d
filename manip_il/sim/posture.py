"""Postures that an arm begins in: whether its `home` is free, and others that are drawn around it."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UsageError
from manip_il.robots.robot import GRIPPER, Robot
from manip_il.sim.world import World

F64 = NDArray[np.float64]
_MAX_DRAWS = 100
_DEEP = 1e-3  # parts that overlap by less touch at most [m]
_BEYOND = 1e-6  # a limit, in rounding [rad]
Pair = tuple[str, str]


def meeting_at(robot: Robot, model: mujoco.MjModel, prefix: str, posture: F64) -> dict[Pair, float]:
    """Return the pairs of bodies that overlap in a posture of the arm (arm,) [rad], the gripper open, and how deep [m].

    Pairs of the robot's own, and of it and what stands fixed in the world, which goes by the name of its geom.
    prefix: of the robot's names in a scene's model.
    """
    data, gripper = mujoco.MjData(model), robot.gripper
    for names, values in ((robot.joints, posture), (gripper.joints, gripper.open)):
        for name, value in zip(names, values, strict=True):
            data.joint(prefix + name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    found: dict[Pair, float] = {}
    for contact in data.contact:
        bodies = [int(model.geom_bodyid[geom]) for geom in (contact.geom1, contact.geom2)]
        ours = [model.body(body).name.startswith(prefix) for body in bodies]
        if contact.dist < -_DEEP and any(ours) and all(our or not body for our, body in zip(ours, bodies, strict=True)):
            geoms = (contact.geom1, contact.geom2)
            names = [_name(model, int(geom), prefix) for geom in geoms]
            pair = (min(names), max(names))
            found[pair] = max(found.get(pair, 0.0), -float(contact.dist))
    return found


def require_free_home(robot: Robot, model: mujoco.MjModel, prefix: str) -> None:
    """Raise `UsageError` for a `home` beyond a joint's limits, or in which parts overlap.

    Two of the robot's own may overlap where they do so at zero, too: many models have such neighbours.
    """
    for name, value in zip(robot.joints, robot.home, strict=True):
        joint = model.joint(prefix + name)
        low, high = joint.range
        if joint.limited[0] and not low - _BEYOND <= value <= high + _BEYOND:
            raise UsageError(
                f"robot {robot.name}: home has {value:g} for joint {name!r}, whose limits are {low:.4g} to {high:.4g}; "
                "choose another home, or leave it out, then it is found"
            )
    meeting = meeting_at(robot, model, prefix, np.asarray(robot.home))
    if not meeting:
        return
    bodies = {model.body(body).name.removeprefix(prefix) for body in range(1, model.nbody)}
    always = {pair for pair in meeting_at(robot, model, prefix, np.zeros(len(robot.joints))) if bodies.issuperset(pair)}
    for (one, other), depth in sorted(meeting.items(), key=lambda item: -item[1]):
        if (one, other) not in always:
            mounted = one.startswith(GRIPPER) != other.startswith(GRIPPER)
            mount = ", gripper.position or gripper.quaternion" if mounted else ""
            raise UsageError(
                f"robot {robot.name}: at home {one!r} and {other!r} overlap by {1000 * depth:.0f} mm; choose another "
                f"home, or leave it out, then it is found; or mend base or workspace.centre{mount}"
            )


def _name(model: mujoco.MjModel, geom: int, prefix: str) -> str:
    body = int(model.geom_bodyid[geom])
    return model.body(body).name.removeprefix(prefix) if body else model.geom(geom).name


def draw_posture(world: World, rng: np.random.Generator, largest: float) -> None:
    """Turn every arm joint, and what it is commanded, by up to `largest` [rad] from where it stands.

    The arm then touches nothing that it did not touch before, and the hand is where it gets to pointing down. The arm
    stays where it was if no such posture is drawn.
    """
    scene, data = world.scene, world.data
    low, high = (scene.actions.split(end)[0] for end in (scene.actions.low, scene.actions.high))
    before = data.qpos[scene.arm_q].copy()
    _stand(world, before)
    touching = _arm_contacts(world)
    for _ in range(_MAX_DRAWS):
        offsets = rng.uniform(-largest, largest, len(before))
        _stand(world, np.minimum(np.maximum(before + offsets, low), high))
        if _arm_contacts(world) <= touching and world.reach.has(world.ee.position):
            return
    _stand(world, before)


def _stand(world: World, q: F64) -> None:
    world.data.qpos[world.scene.arm_q] = world.data.ctrl[world.scene.arm_ctrl] = q
    world.update()
    mujoco.mj_collision(world.model, world.data)


def _arm_contacts(world: World) -> set[tuple[int, int]]:
    """Pairs of geoms in contact, of which at least one is the robot's."""
    model = world.scene.model
    robot = model.body_rootid[model.site_bodyid[world.scene.ee_site]]
    roots = model.body_rootid[model.geom_bodyid]
    pairs = world.data.contact.geom
    return {(int(a), int(b)) for a, b in pairs if robot in (roots[a], roots[b])}
