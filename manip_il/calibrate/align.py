"""Cameras' poses and lenses, and the joints' zeros, from pictures of a board lying on the table.

Everything unknown is in one least-squares problem: each camera's pose (in the world, or in the
hand), focal length and radial distortion, each place of the board, the joints' zeros, and the size
of the print. The pinhole model is OpenCV's. The encoders' errors move all corners of a picture
together, so that its residuals are divided by a root of their covariance; the sizes of the errors
of corners and of encoders are estimated, too.

Two zeros are held, as no picture tells them: the first joint's, since the base's yaw is unknown,
and the last one's, since the mount of the camera on the hand is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import mujoco
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from manip_il.calibrate.sightings import ODD, Sighting, Sightings, require_enough
from manip_il.errors import ManipError
from manip_il.mdp import F64, I64
from manip_il.robots.robot import WRIST, Robot
from manip_il.robots.spec import arm_model

# standard deviations of what is known beforehand
ZERO = np.radians(3.0)  # of a joint's zero [rad]
_FLAT, _LEVEL = 1e-3, 0.005  # of the board's height over the table [m] and of its tilt [rad]
_BENT = 0.1  # of a coefficient of distortion
_FOCAL = 0.5  # of the logarithm of the focal length in widths of the picture
_SIZES = 0.1, 0.1, 0.002  # of the print's relative size, in each round
ROUNDS = len(_SIZES)
_MISPRINT, _SURE = 0.01, 4.0  # relative error of the print that is refused, and in deviations
_PIXEL, _ENCODER = 0.5, np.radians(0.2)  # first standard deviations of errors [pixel], [rad]
_LEAST_PIXEL = 0.1  # [pixel]
_OUTLIER = 4.0  # residuals beyond so many deviations count less (Huber)
_ODD = 3.0  # a picture with so many times the usual residuals is not used
_LENS = 9  # parameters of a camera: rotation vector, position, log of focal length, k1, k2
_STEP = 1e-4  # of the derivatives by joints [rad]
_EVALUATIONS = 40  # of the fit, in a round
_UPDATES = 20  # of the estimate of the errors' sizes, in a round
_FIXED = cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
_GUESSED = _FIXED | cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO


@dataclass(frozen=True)
class Aligned:
    """Cameras and zeros with which the board is seen where it was.

    Attributes:
        sizes: Width and height of each camera's pictures [pixels].
        lenses: Their parameters, (c, 9): rotation vector [rad] and position [m] in the world, the
            wrist camera's in the frame `ee`; logarithm of the focal length [pixels]; k1, k2. A
            camera's x is right in its pictures, y down, z ahead.
        lens_deviations: Their standard deviations, (c, 9).
        zeros: What to add to the encoders' angles, (arm,) [rad].
        zero_deviations: Their standard deviations, (arm,); infinite if the data do not tell them.
        encoder: Standard deviation of the encoders' angles [rad].
        used: What was fitted.
        modelled: Where the model has the corners of each of these sightings, (c, 2) [pixels].
        thrown: How many pictures were not used, by camera and reason.
    """

    sizes: dict[str, tuple[int, int]]
    lenses: F64
    lens_deviations: F64
    zeros: F64
    zero_deviations: F64
    encoder: float
    used: Sequence[Sighting]
    modelled: Sequence[F64]
    thrown: Counter[tuple[str, str]]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(self.sizes)


class HandPoses:
    """Poses of the frame `ee`, which carries the wrist camera.

    Args:
        robot: The robot.
    """

    def __init__(self, robot: Robot):
        self._model = arm_model(robot)
        self._data = mujoco.MjData(self._model)
        self._q: I64 = np.array([self._model.joint(name).qposadr[0] for name in robot.joints])
        self._site: int = self._model.site("ee").id

    def pose(self, joints: F64) -> tuple[F64, F64]:
        """Return position (3,) [m] and rotation (3, 3) at joint angles (arm,) [rad]."""
        self._data.qpos[self._q] = joints
        mujoco.mj_kinematics(self._model, self._data)
        rotation = self._data.site_xmat[self._site].reshape(3, 3)
        return self._data.site_xpos[self._site].copy(), rotation.copy()


def project(lens: F64, size: tuple[int, int], points: F64) -> F64:
    """Return where a camera sees points, across and down from the upper left, (c, 2) [pixels].

    Args:
        lens: Its parameters, as in `Aligned`, (9,).
        size: Width and height of its pictures [pixels].
        points: The points in the frame of its pose, (c, 3) [m].
    """
    seen = (points - lens[3:6]) @ Rotation.from_rotvec(lens[:3]).as_matrix()
    plane = seen[:, :2] / np.maximum(seen[:, 2:], 1e-3)
    square = (plane**2).sum(axis=1, keepdims=True)
    bent = plane * (1 + lens[7] * square + lens[8] * square**2)
    return np.exp(lens[6]) * bent + np.array(size) / 2


@threadpool_limits.wrap(limits=1)  # threads cost more than they save in products this small
def align(
    robot: Robot, found: Sightings, what: str, on_round: Callable[[], None] = lambda: None
) -> Aligned:
    """Find the cameras and zeros with which the board is seen where it was.

    Args:
        robot: The robot.
        found: The sightings, with at least those that `require_enough` asks for.
        what: Where they are from, for messages.
        on_round: Called after each of `ROUNDS` rounds of the fit.

    Raises:
        ManipError: If the board was printed at another size, or too few pictures fit together.
    """
    sizes = {name: size for name, size in found.sizes.items() if name in _cameras_of(found.used)}
    problem = _Problem(robot, sizes, _merged(found.used))
    values, thrown = problem.start(), found.thrown.copy()
    pixel, encoder = np.full(len(sizes), _PIXEL), _ENCODER
    deviations = np.empty_like(values)
    for size in _SIZES:
        roots = problem.roots(values, pixel, encoder)
        values, deviations = problem.fit(values, roots, size)
        errors = problem.errors(values)
        spread = [np.mean((root @ one) ** 2) for root, one in zip(roots, errors, strict=True)]
        odd = np.array(spread) > max(1.0, float(np.median(spread))) * _ODD**2
        thrown.update((problem.used[number].camera, ODD) for number in np.flatnonzero(odd))
        kept = [one for one, is_odd in zip(problem.used, odd, strict=True) if not is_odd]
        require_enough(kept, what)
        if lost := [*sizes.keys() - _cameras_of(kept)]:
            raise ManipError(
                f"{what}: what {lost[0]} sees does not fit; lay the board nearer to it"
            )
        problem.use(kept)
        pixel, encoder = problem.noise(values, pixel, encoder)
        _require_size(what, values[-1], deviations[-1])
        on_round()
    lenses, _, zeros = problem.parts(values)
    lens_deviations, _, zero_deviations = problem.parts(deviations)
    zero_deviations[[0, -1]] = np.inf
    modelled = [
        one.pixels + error.reshape(-1, 2)
        for one, error in zip(problem.used, problem.errors(values), strict=True)
    ]
    return Aligned(
        sizes,
        lenses,
        lens_deviations,
        zeros,
        zero_deviations,
        encoder,
        problem.used,
        modelled,
        thrown,
    )


def _require_size(what: str, log_size: float, deviation: float) -> None:
    if abs(log_size) > max(_MISPRINT, _SURE * deviation):
        raise ManipError(
            f"{what}: the board seems to be printed at {100 * np.exp(log_size):.1f} % of its size;"
            " measure the line below it and give --ruler=MILLIMETRES"
        )


def _cameras_of(used: Sequence[Sighting]) -> set[str]:
    return {one.camera for one in used}


def _merged(used: Sequence[Sighting]) -> list[Sighting]:
    """Merge what a camera that does not move saw of the board at one place.

    Its errors are alike in all pictures, and would otherwise count as often.
    """
    merged = [one for one in used if one.camera == WRIST]
    fixed = [one for one in used if one.camera != WRIST]
    for camera, place in sorted({(one.camera, one.place) for one in fixed}):
        same = [one for one in fixed if (one.camera, one.place) == (camera, place)]
        every = np.concatenate([one.corners for one in same])
        pixels = np.concatenate([one.pixels for one in same])
        corners, where = np.unique(every, axis=0, return_inverse=True)
        middle = [np.median(pixels[where.ravel() == row], axis=0) for row in range(len(corners))]
        merged.append(replace(same[0], corners=corners, pixels=np.array(middle)))
    return merged


class _Problem:
    """The parameters in one vector: cameras, places of the board, zeros but two, log of its size.

    `used` has the sightings.
    """

    def __init__(self, robot: Robot, sizes: dict[str, tuple[int, int]], used: list[Sighting]):
        self._hand = HandPoses(robot)
        self._sizes = sizes
        self._names = [*sizes]
        self._eye = np.eye(len(robot.joints))
        self._places = sorted({one.place for one in used})
        self.use(used)

    def use(self, used: list[Sighting]) -> None:
        """Fit these sightings from now on."""
        self.used = used
        counts = [len(one.corners) for one in used]
        self._number = np.repeat(np.arange(len(used)), counts)  # of each corner's sighting
        self._ends = np.cumsum(counts)[:-1]
        self._corners = np.concatenate([one.corners for one in used])
        self._pixels = np.concatenate([one.pixels for one in used])
        self._camera = np.array([self._names.index(one.camera) for one in used])
        self._place = np.array([self._places.index(one.place) for one in used])

    def parts(self, values: F64) -> tuple[F64, F64, F64]:
        """Return cameras (c, 9), boards (b, 6) and zeros (arm,)."""
        edge = _LENS * len(self._names)
        lenses, boards = values[:edge], values[edge : 1 - len(self._eye)]
        zeros = np.concatenate([[0.0], values[1 - len(self._eye) : -1], [0.0]])
        return lenses.reshape(-1, _LENS), boards.reshape(-1, 6), zeros

    def _frames(self, zeros: F64) -> tuple[F64, F64]:
        """Return what carries the camera of each sighting: position (s, 3), rotation (s, 3, 3)."""
        fixed = np.zeros(3), np.eye(3)
        poses = [
            self._hand.pose(one.joints + zeros) if one.camera == WRIST else fixed
            for one in self.used
        ]
        position, rotation = zip(*poses, strict=True)
        return np.array(position), np.array(rotation)

    def errors(self, values: F64, shift: F64 | float = 0.0) -> list[F64]:
        """Return modelled minus seen pixels of each sighting, (2c,).

        Args:
            values: The parameters.
            shift: What to add to the joints [rad], (arm,).
        """
        lenses, boards, zeros = self.parts(values)
        turns = Rotation.from_rotvec(boards[:, 3:]).as_matrix()
        positions, rotations = self._frames(zeros + shift)
        # from the board to the frame that carries the camera
        rotation = rotations.transpose(0, 2, 1) @ turns[self._place]
        offset = boards[self._place, :3] - positions
        offset = np.einsum("sji,sj->si", rotations, offset)
        points = np.einsum("cij,cj->ci", rotation[self._number], np.exp(values[-1]) * self._corners)
        points = points + offset[self._number]
        found = np.empty_like(self._pixels)
        for number, name in enumerate(self._names):
            of = self._camera[self._number] == number
            found[of] = project(lenses[number], self._sizes[name], points[of])
        return [one.ravel() for one in np.split(found - self._pixels, self._ends)]

    def _slopes(self, values: F64) -> list[F64]:
        """Return the derivatives of each sighting's errors by joints, (2c, arm)."""
        steps = _STEP * self._eye
        ends = [(self.errors(values, one), self.errors(values, -one)) for one in steps]
        return [
            np.array([more[number] - less[number] for more, less in ends]).T / (2 * _STEP)
            for number in range(len(self.used))
        ]

    def roots(self, values: F64, pixel: F64, encoder: float) -> list[F64]:
        """Return what divides each sighting's errors by a root of their covariance, (2c, 2c).

        Args:
            values: The parameters.
            pixel: Standard deviation of each camera's corners, (c,) [pixels].
            encoder: Standard deviation of the encoders' angles [rad].
        """
        found: list[F64] = []
        for slopes, camera in zip(self._slopes(values), self._camera, strict=True):
            noise = pixel[camera] ** 2 * np.eye(len(slopes))
            covariance = noise + encoder**2 * slopes @ slopes.T
            found.append(np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), float))
        return found

    def noise(self, values: F64, pixel: F64, encoder: float) -> tuple[F64, float]:
        """Return better standard deviations, by expectation and maximisation.

        Args:
            values: The parameters.
            pixel: As in `roots`, (c,) [pixels].
            encoder: As in `roots` [rad].
        """
        seen = [*zip(self.errors(values), self._slopes(values), self._camera, strict=True)]
        for _ in range(_UPDATES):
            left: list[list[F64]] = [[] for _ in pixel]
            squares: list[F64] = []
            for error, slopes, camera in seen:
                weight = slopes.T / pixel[camera] ** 2
                variance = np.linalg.inv(weight @ slopes + self._eye / encoder**2)
                moved = variance @ weight @ error
                left[camera].append(error - slopes @ moved)
                if slopes.any():  # the camera is on the hand
                    squares.append(moved**2 + np.diag(variance))
            encoder = float(np.sqrt(np.mean(squares)))
            typical = [1.4826 * np.median(np.abs(np.concatenate(one))) for one in left]
            pixel = np.maximum(typical, _LEAST_PIXEL)
        return pixel, encoder

    def fit(self, values: F64, roots: Sequence[F64], size: float) -> tuple[F64, F64]:
        """Return the parameters that fit best, and their standard deviations.

        Args:
            values: The first guess.
            roots: As `roots` returns them.
            size: Standard deviation of the print's relative size.
        """
        widths = np.log([width for width, _ in self._sizes.values()])

        def residuals(values: F64) -> F64:
            lenses, boards, zeros = self.parts(values)
            known = [
                zeros[1:-1] / ZERO,
                boards[:, 2] / _FLAT,
                boards[:, 3:5].ravel() / _LEVEL,
                (lenses[:, 6] - widths) / _FOCAL,
                lenses[:, 7:].ravel() / _BENT,
                values[-1:] / size,
            ]
            seen = [root @ one for root, one in zip(roots, self.errors(values), strict=True)]
            return np.concatenate(seen + known)

        found: Any = least_squares(
            residuals,
            values,
            jac="3-point",
            x_scale="jac",
            loss="huber",
            f_scale=_OUTLIER,
            max_nfev=_EVALUATIONS,
        )
        return found.x, np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)))

    def start(self) -> F64:
        """Return a first guess of all parameters, from each camera alone."""
        views = {name: self._views(name) for name in self._names}
        lens, poses = views[WRIST]
        hands = [_matrix(*self._hand.pose(one.joints)) for one, _ in poses]
        most = max(self._places, key=[one.place for one, _ in poses].count)
        chosen = [number for number, (one, _) in enumerate(poses) if one.place == most]
        turns, place = cv2.calibrateHandEye(
            [hands[number][:3, :3] for number in chosen],
            [hands[number][:3, 3] for number in chosen],
            [poses[number][1][:3, :3] for number in chosen],
            [poses[number][1][:3, 3] for number in chosen],
            method=cv2.CALIB_HAND_EYE_PARK,
        )
        mount = _matrix(place, turns)
        boards: dict[int, F64] = {}
        for hand, (one, board) in zip(hands, poses, strict=True):
            boards.setdefault(one.place, hand @ mount @ board)
        lenses: list[F64] = []
        for name, (lens, poses) in views.items():
            one, board = max(poses, key=lambda view: len(view[0].corners))
            pose = mount if name == WRIST else boards[one.place] @ np.linalg.inv(board)
            lenses.append(np.concatenate([_vector(pose), lens]))
        flat = [
            [*boards[place][:2, 3], 0, 0, 0, np.arctan2(*boards[place][1::-1, 0])]
            for place in self._places
        ]
        return np.concatenate([*lenses, *flat, np.zeros(len(self._eye) - 1)])

    def _views(self, name: str) -> tuple[F64, list[tuple[Sighting, F64]]]:
        """Return a camera's log of focal length, k1 and k2, and poses of the board before it."""
        used = [one for one in self.used if one.camera == name]
        width, height = self._sizes[name]
        guess = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
        _, matrix, bent, turns, places = cv2.calibrateCamera(
            [one.corners.astype(np.float32) for one in used],
            [one.pixels.astype(np.float32) for one in used],
            (width, height),
            guess,
            np.zeros(5),
            flags=_GUESSED,
        )
        focal = width * np.exp(np.clip(np.log(matrix[0, 0] / width), -_FOCAL, _FOCAL))
        lens = np.array([np.log(focal), *np.clip(bent.ravel()[:2], -_BENT, _BENT)])
        poses = [
            _matrix(place, Rotation.from_rotvec(turn.ravel()).as_matrix())
            for turn, place in zip(turns, places, strict=True)
        ]
        return lens, [*zip(used, poses, strict=True)]


def _matrix(position: Any, rotation: Any) -> F64:
    """Return a pose as a matrix, (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, np.ravel(position)
    return pose


def _vector(pose: F64) -> F64:
    """Return a pose's rotation vector and position, (6,)."""
    return np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3]])
