"""The wrist camera sees both fingers on every arm, open, half open and closed."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from manip_il.robots import ROBOTS
from manip_il.sim.scene import PREFIX, camera_id
from manip_il.sim.world import World
from manip_il.worlds.ladder.world import scene_of

from .own import EXAMPLES

GRID = 48  # rays a side
LEAST = 0.005  # of the picture
OPEN = 0.03  # as far as a model's own camera, which is where it is, has to see both [m]
SHOWN = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)  # groups of geoms
SETTLE = 500  # physics steps


def bodies_seen(world: World, camera: int) -> np.ndarray:
    """The body at the end of every ray through a square picture, -1 for none, (GRID^2,)."""
    model, data = world.scene.model, world.data
    edge = np.tan(np.radians(model.cam_fovy[camera]) / 2) * (2 * (np.arange(GRID) + 0.5) / GRID - 1)
    across, up = np.meshgrid(edge, edge)
    rays = np.stack([across.ravel(), up.ravel(), -np.ones(GRID**2)], axis=1)
    rays = rays @ data.cam_xmat[camera].reshape(3, 3).T
    geoms, distances = np.empty(len(rays), np.int32), np.empty(len(rays))
    where, farthest = data.cam_xpos[camera], 10.0
    mujoco.mj_multiRay(
        model, data, where, rays.ravel(), SHOWN, 1, -1, geoms, distances, None, len(rays), farthest
    )
    return np.where(geoms >= 0, model.geom_bodyid[geoms], -1)


def owner(world: World, body: int) -> str:
    """The finger that a body belongs to, or none."""
    scene = world.scene
    fingers = {scene.model.body(PREFIX + name).id: name for name in scene.robot.gripper.fingers}
    while body > 0 and body not in fingers:
        body = int(scene.model.body_parentid[body])
    return fingers.get(body, "")


@pytest.mark.parametrize("robot", [*ROBOTS, *EXAMPLES], ids=lambda robot: Path(robot).stem)
def test_both_fingers_are_in_view(robot: str | Path):
    world = World(scene_of(robot, "reach"))
    scene, data = world.scene, world.data
    data.qpos[scene.arm_q] = data.ctrl[scene.arm_ctrl] = scene.robot.home
    data.qpos[scene.gripper.q] = scene.gripper.command(scene.gripper.least)
    most = OPEN if isinstance(scene.robot.wrist_camera, str) else scene.gripper.most
    for opening in (scene.gripper.least, (scene.gripper.least + most) / 2, most):
        data.ctrl[scene.gripper.ctrl] = scene.gripper.command(opening)
        mujoco.mj_step(scene.model, data, SETTLE)
        seen = [owner(world, body) for body in bodies_seen(world, camera_id(scene.model, "wrist"))]
        for finger in scene.robot.gripper.fingers:
            assert seen.count(finger) > LEAST * len(seen), (
                f"{finger}, with the hand open by {opening:.3f} m"
            )
