"""Cameras' poses and lenses, and the joints' zeros, from pictures of a board that lies on the table.

One problem of least squares with everything that is unknown: for each camera its pose (in the
world, or in the hand), focal length and radial distortion; for each episode where the board lies;
for each joint of the arm its zero. The pinhole model and the order of parameters are OpenCV's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from manip_il.mdp import F64, I64
from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_model

# standard deviations of what is known beforehand
ZERO = np.radians(3.0)  # of a joint's zero [rad]
FLAT, LEVEL = 1e-3, 0.005  # of the board's height over the table [m] and of its tilt [rad]
BENT = 0.1  # of a coefficient of distortion
NOISE = 0.5  # of a corner [pixel]
_OUTLIER = 4.0  # residuals beyond so many deviations count less (Huber)
_LENS = 9  # parameters of a camera: rotation vector, position, focal length, k1, k2


@dataclass(frozen=True)
class Sighting:
    """The board in one picture.

    Attributes:
        camera: Number of the camera.
        board: Number of the place where the board lies.
        joints: The arm's joint angles as its encoders have them, (arm,) [rad].
        corners: Positions of the corners on the board, (c, 3) [m].
        pixels: Where they are in the picture, across and down, (c, 2).
    """

    camera: int
    board: int
    joints: F64
    corners: F64
    pixels: F64


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: x right, y down, z ahead.

    Attributes:
        in_hand: Whether its pose is in the frame of the hand's body, not in the world.
        size: Width and height of its pictures [pixels].
        position: Its position, (3,) [m].
        rotation: Its rotation vector, (3,) [rad].
        focal: Focal length [pixels].
        bent: Coefficients of radial distortion, k1 and k2, (2,).
    """

    in_hand: bool
    size: tuple[int, int]
    position: F64
    rotation: F64
    focal: float
    bent: F64

    def project(self, points: F64) -> F64:
        """Return where points (c, 3) [m], in the frame of the camera's pose, are seen, (c, 2)."""
        seen = (points - self.position) @ Rotation.from_rotvec(self.rotation).as_matrix()
        plane = seen[:, :2] / np.maximum(seen[:, 2:], 1e-3)
        square = (plane**2).sum(axis=1, keepdims=True)
        bent = plane * (1 + self.bent[0] * square + self.bent[1] * square**2)
        return self.focal * bent + np.array(self.size) / 2


@dataclass(frozen=True)
class Aligned:
    """Cameras, boards and zeros that fit to sightings.

    Attributes:
        cameras: The cameras.
        boards: Position and rotation vector of every board in the world, (b, 6) [m], [rad].
        zeros: What to add to the encoders' angles, (arm,) [rad].
        deviations: Standard deviations of all parameters: cameras', zeros, boards'.
        errors: Distances between corners where they were seen and where the model has them, one
            array a sighting [pixels].
    """

    cameras: tuple[Camera, ...]
    boards: F64
    zeros: F64
    deviations: F64
    errors: tuple[F64, ...]


class Hand:
    """Poses of the hand's body, which carries cameras.

    Args:
        robot: The robot.
    """

    def __init__(self, robot: Robot):
        self._model = arm_model(robot)
        self._data = mujoco.MjData(self._model)
        self._q: I64 = np.array([self._model.joint(name).qposadr[0] for name in robot.joints])
        self._body = int(self._model.site_bodyid[self._model.site("ee").id])

    def pose(self, joints: F64) -> tuple[F64, F64]:
        """Return position (3,) [m] and rotation (3, 3) at joint angles (arm,) [rad]."""
        self._data.qpos[self._q] = joints
        mujoco.mj_kinematics(self._model, self._data)
        rotation = self._data.xmat[self._body].reshape(3, 3)
        return self._data.xpos[self._body].copy(), rotation.copy()


def align(
    robot: Robot,
    cameras: Sequence[Camera],
    boards: F64,
    sightings: Sequence[Sighting],
    on_step: Callable[[], None] = lambda: None,
) -> Aligned:
    """Find the cameras and zeros with which boards are seen where they were.

    Args:
        robot: The robot.
        cameras: The cameras, roughly.
        boards: Where boards lie, roughly, (b, 6): position [m] and rotation vector [rad].
        sightings: What was seen.
        on_step: Called at every step of the fit.
    """
    hand, count = Hand(robot), len(robot.joints)
    first = np.concatenate(
        [
            *(
                [*one.rotation, *one.position, np.log(one.focal), *one.bent]
                for one in cameras
            ),
            np.zeros(count),
            boards.ravel(),
        ]
    )
    edge = _LENS * len(cameras)

    def parts(values: F64) -> tuple[list[Camera], F64, F64]:
        lenses = [
            Camera(one.in_hand, one.size, row[3:6], row[:3], float(np.exp(row[6])), row[7:])
            for one, row in zip(cameras, values[:edge].reshape(-1, _LENS), strict=True)
        ]
        return lenses, values[edge : edge + count], values[edge + count :].reshape(-1, 6)

    def misses(values: F64) -> list[F64]:
        lenses, zeros, places = parts(values)
        turns = [Rotation.from_rotvec(one).as_matrix() for one in places[:, 3:]]
        found: list[F64] = []
        for one in sightings:
            points = one.corners @ turns[one.board].T + places[one.board, :3]
            lens = lenses[one.camera]
            if lens.in_hand:
                position, rotation = hand.pose(one.joints + zeros)
                points = (points - position) @ rotation
            found.append(lens.project(points) - one.pixels)
        return found

    def residuals(values: F64) -> F64:
        lenses, zeros, places = parts(values)
        known = [
            zeros / ZERO,
            places[:, 2] / FLAT,
            places[:, 3:5].ravel() / LEVEL,
            np.concatenate([one.bent for one in lenses]) / BENT,
        ]
        seen = np.concatenate(misses(values)).ravel() / NOISE
        size = np.abs(seen)
        # Huber's loss as residuals: beyond `_OUTLIER` their squares grow linearly
        far = np.sign(seen) * np.sqrt(np.maximum(2 * _OUTLIER * size - _OUTLIER**2, 0))
        return np.concatenate([np.where(size < _OUTLIER, seen, far), *known])

    def stepped(values: F64) -> F64:
        on_step()
        return _slopes(residuals, values)

    found = least_squares(residuals, first, jac=stepped, x_scale="jac", max_nfev=60)
    lenses, zeros, places = parts(found.x)
    curve = found.jac.T @ found.jac
    deviations = np.sqrt(np.diag(np.linalg.pinv(curve)))
    errors = tuple(np.linalg.norm(one, axis=1) for one in misses(found.x))
    return Aligned(tuple(lenses), places, zeros, deviations, errors)


def _slopes(function: Callable[[F64], F64], values: F64, step: float = 1e-6) -> F64:
    """Return derivatives by central differences, (r, p)."""
    columns = [
        (function(values + change) - function(values - change)) / (2 * step)
        for change in step * np.eye(len(values))
    ]
    return np.stack(columns, axis=1)
