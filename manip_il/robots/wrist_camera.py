"""A camera beside the hand, where it sees both fingers: for robots whose model has none of its own."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.robots.robot import Robot
from manip_il.robots.spec import PLAIN, WRIST

F64 = NDArray[np.float64]
# In the `ee` frame, beside the hand and behind the fingertips, the first that sees is taken: side, and offset [m].
_OFFSETS = ((0.10, -0.08), (0.10, -0.11), (0.14, -0.11))  # x and z
_PLACES = tuple((side, (side * x, 0.0, z)) for x, z in _OFFSETS for side in (1, -1))
_TILT = 0.45  # towards the fingertips [rad]
_FOVY = 70.0  # [degrees]
_RAYS = 32  # a side of the picture
_LEAST_FINGER, _MOST_ROBOT = 0.01, 0.25  # shares of the picture
_SHARES = (0.0, 0.5, 1.0)  # of the way from closed to open, at which the fingers are looked at
_SETTLE = 250  # physics steps
_SHOWN = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)  # groups of geoms
_FARTHEST = 0.25  # that is looked for [m]


def add_wrist_camera(spec: mujoco.MjSpec, model: mujoco.MjModel, robot: Robot) -> None:
    """Add the camera `wrist` to a robot's spec. model: the spec compiled."""
    site: Any = spec.site("ee")
    position, quat = best_view(model, robot)
    site.parent.add_camera(PLAIN.default, name=WRIST, pos=position, quat=quat, fovy=_FOVY)


def best_view(model: mujoco.MjModel, robot: Robot) -> tuple[F64, F64]:
    """Return position (3,) [m] and quaternion (4,) wxyz of the camera in the body of `ee`.

    It is the first place from which every finger fills a hundredth of the picture, and what is near of the robot at
    most a quarter, with the hand closed, half open and open; where there is none, that which shows most of the finger
    that is seen least. model: of the robot alone.
    """
    hands, owners = _hands(model, robot), _owners(model, robot)
    best, most = _PLACES[0], -1.0
    for place in _PLACES:
        views = [_shares(model, data, _pose(model, *place), owners) for data in hands]
        least = min(min(fingers) for fingers, _ in views)
        if least >= _LEAST_FINGER and max(whole for _, whole in views) <= _MOST_ROBOT:
            return _pose(model, *place)
        if least > most:
            best, most = place, least
    return _pose(model, *best)


def _hands(model: mujoco.MjModel, robot: Robot) -> list[mujoco.MjData]:
    """The robot at home with its fingers closed, half open and open."""
    data, gripper = mujoco.MjData(model), robot.gripper
    for name, value in zip(robot.joints, robot.home, strict=True):
        data.joint(name).qpos[0] = data.actuator(name).ctrl[0] = value
    for name, value in zip(gripper.joints, gripper.closed, strict=True):
        data.joint(name).qpos[0] = value
    found = []
    for share in _SHARES:
        for name, closed, opened in zip(gripper.joints, gripper.closed, gripper.open, strict=True):
            data.actuator(name).ctrl[0] = closed + share * (opened - closed)
        mujoco.mj_step(model, data, _SETTLE)
        mujoco.mj_kinematics(model, data)
        found.append(data.__copy__())
    return found


def _owners(model: mujoco.MjModel, robot: Robot) -> NDArray[np.int64]:
    """For every body the finger that it is part of, -1 for none, (b + 1,); the last is for rays that meet nothing."""
    owners = np.full(model.nbody + 1, -1, dtype=np.int64)
    fingers = {model.body(name).id: place for place, name in enumerate(robot.gripper.fingers)}
    for body in range(1, model.nbody):
        owners[body] = fingers.get(body, owners[model.body_parentid[body]])
    return owners


def _pose(model: mujoco.MjModel, side: int, offset: tuple[float, float, float]) -> tuple[F64, F64]:
    """Position and quaternion in the body of `ee`; the camera looks along its -z, and its x is the hand's y."""
    rotation, quat, site = np.zeros(9), np.zeros(4), model.site("ee")
    mujoco.mju_quat2Mat(rotation, site.quat)
    back = np.array([side * np.sin(_TILT), 0, -np.cos(_TILT)])
    right = np.array([0.0, float(side), 0.0])
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    rotation = rotation.reshape(3, 3)
    mujoco.mju_mat2Quat(quat, (rotation @ axes).flatten())
    return site.pos + rotation @ np.array(offset), quat


def _shares(
    model: mujoco.MjModel, data: mujoco.MjData, pose: tuple[F64, F64], owners: NDArray[np.int64]
) -> tuple[list[float], float]:
    """What shares of a picture the fingers and the whole robot take."""
    body, axes = data.body(int(model.site("ee").bodyid[0])), np.zeros(9)
    mujoco.mju_quat2Mat(axes, pose[1])
    turned = body.xmat.reshape(3, 3)
    edge = np.tan(np.radians(_FOVY) / 2) * (2 * (np.arange(_RAYS) + 0.5) / _RAYS - 1)
    across, up = np.meshgrid(edge, edge)
    rays = np.stack([across.ravel(), up.ravel(), -np.ones(_RAYS**2)], axis=1) @ (turned @ axes.reshape(3, 3)).T
    geoms, distances, eye = np.empty(len(rays), np.int32), np.empty(len(rays)), body.xpos + turned @ pose[0]
    mujoco.mj_multiRay(model, data, eye, rays.ravel(), _SHOWN, 1, -1, geoms, distances, None, len(rays), _FARTHEST)
    seen = owners[np.where(geoms >= 0, model.geom_bodyid[geoms], -1)]
    return [float((seen == finger).mean()) for finger in range(owners.max() + 1)], float((geoms >= 0).mean())
