"""How one of our episodes looks in Foxglove: which column fills which channel."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data import schema as s
from manip_il.errors import ManipError
from manip_il.mcap import foxglove
from manip_il.mdp import Episode

F64 = NDArray[np.float64]

_JOINT_TOPICS = {"/joint_states": s.STATE, "/action": s.ACTION, "/executed_action": s.EXECUTED_ACTION}
_SCALARS = (s.ACTOR, s.EXPERT_PHASE, s.LABEL_VALID, s.REWARD, s.SUCCESS, s.DONE)


def channels(episode: Episode, spec: s.RobotTaskSpec) -> Iterator[foxglove.Channel]:
    """Yield every channel that the episode's columns can fill.

    Raises `ManipError` for pictures that are not uint8 (T, height, width, 3).
    """
    times = frame_times(episode, spec)
    for topic, key in _JOINT_TOPICS.items():
        values = _matrix(episode, key, len(spec.joint_names))
        if values is not None:
            yield foxglove.joint_states(topic, spec.joint_names, values, times)
    places = _places(episode, spec.environment_state_names)
    if places:
        yield foxglove.frame_transforms("/tf", places, times)
    labels = [key for key in _SCALARS if _is_scalar(episode, key)]
    if labels:
        columns = [_numbers(episode.columns[label]) for label in labels]
        yield foxglove.scalars("/scalars", labels, zip(*columns, strict=True))
    for key, pictures in episode.columns.items():
        if key.startswith(s.IMAGES):
            camera = key.removeprefix(s.IMAGES)
            yield foxglove.images(foxglove.IMAGE_TOPICS + camera, camera, _pictures(episode, key, pictures), times)


def frame_times(episode: Episode, spec: s.RobotTaskSpec) -> list[int]:
    """Return every frame's log time [ns]."""
    return [foxglove.log_time(frame, spec.fps) for frame in range(len(episode))]


def _places(episode: Episode, names: tuple[str, ...]) -> dict[str, tuple[F64, F64]]:
    """Frame -> positions (T, 3), quaternions wxyz (T, 4)."""
    values = _matrix(episode, s.ENVIRONMENT_STATE, len(names))
    if values is None:
        return {}
    columns = {name: values[:, column].astype(np.float64) for column, name in enumerate(names)}
    return {frame: (_stack(columns, frame, "xyz"), _rotations(frame, columns)) for frame in _frames(names)}


def _frames(names: tuple[str, ...]) -> list[str]:
    """Things with a place in the world: `a_from_b` is a difference, and no frame."""
    found = [name[: -len(".x")] for name in names if name.endswith(".x")]
    return [frame for frame in found if "_from_" not in frame and {f"{frame}.y", f"{frame}.z"} <= set(names)]


def _rotations(frame: str, columns: dict[str, F64]) -> F64:
    """T_world_frame's quaternions wxyz, (T, 4): from two axes, from a cube's yaw, else none."""
    y_axis, z_axis = (f"rx{axis} ry{axis} rz{axis}".split() for axis in "yz")
    if all(f"{frame}.{name}" in columns for name in itertools.chain(y_axis, z_axis)):
        y, z = (np.clip(_stack(columns, frame, axis), -1, 1) for axis in (y_axis, z_axis))
        return _quaternions(np.stack([np.cross(y, z), y, z], axis=2))
    x = columns[f"{frame}.x"]
    zero = np.zeros(len(x))
    if f"{frame}.cos4yaw" in columns:
        yaw = np.arctan2(columns[f"{frame}.sin4yaw"], columns[f"{frame}.cos4yaw"]) / 4
        return np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1)
    return np.stack([zero + 1, zero, zero, zero], axis=1)


def _quaternions(rotation: NDArray[np.floating[Any]]) -> F64:
    """Rotation matrices (T, 3, 3) as quaternions wxyz (T, 4).

    The eigenvector of the largest eigenvalue: Bar-Itzhack (2000), New method for extracting the quaternion from a
    rotation matrix, eq. 12; good for matrices that are rotations only nearly.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation.reshape(-1, 9).T
    rows = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, yy - xx - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, zz - xx - yy],
    ]
    _, vectors = np.linalg.eigh(np.moveaxis(np.array(rows), 2, 0))
    quaternion = vectors[:, :, -1]
    return quaternion * np.where(quaternion[:, :1] < 0, -1.0, 1.0)


def _stack(columns: dict[str, F64], frame: str, names: str | list[str]) -> F64:
    return np.stack([columns[f"{frame}.{name}"] for name in names], axis=1)


def _matrix(episode: Episode, key: str, width: int) -> NDArray[Any] | None:
    values = episode.columns.get(key)
    if values is None or values.shape != (len(episode), width) or values.dtype.kind != "f":
        return None
    return values


def _is_scalar(episode: Episode, key: str) -> bool:
    values = episode.columns.get(key)
    return values is not None and values.size == len(episode) and values.dtype.kind in "biuf"


def _numbers(column: NDArray[Any]) -> Sequence[float]:
    flat = column.reshape(-1)
    return (flat.astype(np.int64) if flat.dtype.kind == "b" else flat).tolist()


def _pictures(episode: Episode, key: str, pictures: NDArray[Any]) -> NDArray[np.uint8]:
    if pictures.dtype != np.uint8 or pictures.ndim != 4 or pictures.shape[3] != 3:
        raise ManipError(
            f"episode with seed {episode.seed}, column {key!r} is {pictures.dtype} of shape {pictures.shape}; "
            "expected pictures: uint8 of shape (T, height, width, 3)"
        )
    return pictures
