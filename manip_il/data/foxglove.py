"""How an episode looks in Foxglove: channels, their JSON schemas and messages.

The schemas are Foxglove's own (`JointStates`, `FrameTransforms`; github.com/foxglove/foxglove-sdk, schemas/jsonschema)
without their descriptions, and LeRobot's `lerobot.Scalars`. The messages are for looking at, rounded to 1e-6.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data import schema as s
from manip_il.mdp import Episode

F64 = NDArray[np.float64]
NANOSECONDS = 1_000_000_000
WORLD = "world"
_DECIMALS = 6
_SLOT = "\0"  # stands for a number in a template; no name has this character


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


def _array(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_NUMBER = {"type": "number"}
_STRING = {"type": "string"}
_TIME = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": NANOSECONDS - 1},
    },
}
_STAMP = {"sec": _SLOT, "nsec": _SLOT}
_VECTOR = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_JOINT = _object("foxglove.JointState", name=_STRING, position=_NUMBER)
_TRANSFORM = _object(
    "foxglove.FrameTransform",
    timestamp=_TIME,
    parent_frame_id=_STRING,
    child_frame_id=_STRING,
    translation=_VECTOR,
    rotation=_QUATERNION,
)
JOINT_STATES = _object("foxglove.JointStates", timestamp=_TIME, joints=_array(_JOINT))
FRAME_TRANSFORMS = _object("foxglove.FrameTransforms", transforms=_array(_TRANSFORM))
SCALARS = _object("lerobot.Scalars", scalars=_array(_object("Scalar", label=_STRING, value=_NUMBER)))

_JOINT_TOPICS = {"/joint_states": s.STATE, "/action": s.ACTION, "/executed_action": s.EXECUTED_ACTION}
_SCALARS = (s.ACTOR, s.EXPERT_PHASE, s.LABEL_VALID, s.REWARD, s.SUCCESS, s.DONE)


@dataclass(frozen=True)
class Channel:
    """One topic: its JSON schema and one message a frame, as a template and the numbers that fill it.

    Filling a template is five times as fast as encoding a message's dict.
    """

    topic: str
    schema: dict[str, Any]
    template: str
    rows: list[list[float]]  # T rows

    def messages(self) -> Iterator[bytes]:
        """JSON, one message a frame."""
        return ((self.template % tuple(row)).encode() for row in self.rows)


def channels(episode: Episode, spec: s.RobotTaskSpec) -> Iterator[Channel]:
    """Every channel that the episode's columns can fill."""
    times = np.array([divmod(log_time(frame, spec.fps), NANOSECONDS) for frame in range(len(episode))])
    for topic, key in _JOINT_TOPICS.items():
        values = _matrix(episode, key, len(spec.joint_names))
        if values is not None:
            joints = [{"name": name, "position": _SLOT} for name in spec.joint_names]
            message = {"timestamp": _STAMP, "joints": joints}
            yield Channel(topic, JOINT_STATES, _template(message), _rows(times, values))
    values = _matrix(episode, s.ENVIRONMENT_STATE, len(spec.environment_state_names))
    frames = _frames(spec.environment_state_names)
    if values is not None and frames:
        yield _transforms(times, spec.environment_state_names, frames, values)
    labels = [key for key in _SCALARS if _is_scalar(episode, key)]
    if labels:
        values = np.stack([episode.columns[key].reshape(-1).astype(np.float64) for key in labels], axis=1)
        message = {"scalars": [{"label": label, "value": _SLOT} for label in labels]}
        yield Channel("/scalars", SCALARS, _template(message), _rows(values))


def log_time(frame: int, fps: int) -> int:
    """Nanoseconds since the episode's start."""
    return frame * NANOSECONDS // fps


def _transforms(times: NDArray[np.int64], names: tuple[str, ...], frames: list[str], values: F64) -> Channel:
    place = {name: values[:, column] for column, name in enumerate(names)}
    transforms: list[dict[str, Any]] = []
    parts: list[NDArray[Any]] = []
    for frame in frames:
        axes = {"parent_frame_id": WORLD, "child_frame_id": frame}
        numbers = {"translation": dict.fromkeys("xyz", _SLOT), "rotation": dict.fromkeys("wxyz", _SLOT)}
        transforms.append({"timestamp": _STAMP, **axes, **numbers})
        position = np.stack([place[f"{frame}.{axis}"] for axis in "xyz"], axis=1)
        parts += [times, position, _rotations(frame, place, len(values))]
    return Channel("/tf", FRAME_TRANSFORMS, _template({"transforms": transforms}), _rows(*parts))


def _template(message: dict[str, Any]) -> str:
    """The message's JSON with `%r` for every number to fill in."""
    text = json.dumps(message, separators=(",", ":")).replace("%", "%%")
    return text.replace(json.dumps(_SLOT), "%r")


def _rows(*parts: NDArray[Any]) -> list[list[float]]:
    """Parts (T, .) side by side as rows of Python numbers; whole numbers stay whole."""
    columns = [part if part.dtype.kind == "i" else _rounded(part) for part in parts]
    return [list(chain.from_iterable(row)) for row in zip(*(column.tolist() for column in columns), strict=True)]


def _rounded(values: NDArray[Any]) -> NDArray[Any]:
    with np.errstate(over="ignore"):
        rounded = np.round(values, _DECIMALS)
    return np.where(np.isfinite(rounded), rounded, values)  # rounding multiplies first: 1e308 overflows


def _frames(names: tuple[str, ...]) -> list[str]:
    """Things with a place in the world: `a_from_b` is a difference, and no frame."""
    found = [name[: -len(".x")] for name in names if name.endswith(".x")]
    return [frame for frame in found if "_from_" not in frame and {f"{frame}.y", f"{frame}.z"} <= set(names)]


def _rotations(frame: str, place: dict[str, F64], count: int) -> F64:
    """T_world_frame's quaternions wxyz, (T, 4): from two axes, from a cube's yaw, else none."""
    axes = [[f"{frame}.r{row}{column}" for row in "xyz"] for column in "yz"]
    if all(name in place for axis in axes for name in axis):
        y, z = (np.clip(np.stack([place[name] for name in axis], axis=1), -1, 1) for axis in axes)
        return _quaternions(np.stack([np.cross(y, z), y, z], axis=2))
    if f"{frame}.cos4yaw" in place:
        yaw = np.arctan2(place[f"{frame}.sin4yaw"], place[f"{frame}.cos4yaw"]) / 4
        zero = np.zeros(count)
        return np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1)
    return np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))


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


def _matrix(episode: Episode, key: str, width: int) -> F64 | None:
    values = episode.columns.get(key)
    if values is None or values.shape != (len(episode), width) or values.dtype.kind != "f":
        return None
    return values.astype(np.float64)


def _is_scalar(episode: Episode, key: str) -> bool:
    values = episode.columns.get(key)
    return values is not None and values.size == len(episode) and values.dtype.kind in "biuf"
