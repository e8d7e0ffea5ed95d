"""The columns of a dataset: keys, dtypes and shapes (LeRobot v3.0)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from itertools import zip_longest
from typing import Any

from manip_il import checks
from manip_il.errors import ManipError, MismatchError
from manip_il.mdp import KEYPOINTS
from manip_il.tasks.stock.table import TWO_ARMS

STATE = "observation.state"
ENVIRONMENT_STATE = "observation.environment_state"
IMAGES = "observation.images."  # prefix of a camera's name
ACTION = "action"
EXECUTED_ACTION = "executed_action"
ACTOR = "actor"
LABEL_VALID = "label_valid"
EXPERT_PHASE = "expert_phase"
SIM_STATE = "sim_state"
PROGRESS = "progress"
REWARD = "next.reward"
SUCCESS = "next.success"
DONE = "next.done"
SEED = "seed"
ROUND = "round"
BETA = "beta"

OWN_OBJECT = "the task's own"  # meaning of an empty object name
OPENINGS = "joint position targets [rad], gripper opening command [m]"
SERVOS = "joint position targets [deg], gripper position command [0 to 100]"  # as in LeRobot's recorder
JOINT_TARGETS = (OPENINGS, SERVOS, TWO_ARMS)
GRIPPERS = {TWO_ARMS: (6, 13)}  # action meaning -> indices of the grippers in state and action; by default the last
LEROBOT_TYPES = {"so_follower": "so101"}  # LeRobot's `robot_type` -> our name, if it differs
VERSION = 2  # version of the columns and their meaning: 2 has progress, complete states and named phases
MOST_FPS = 10_000  # highest control rate [Hz]
MUST_AGREE = ("robot", "fps", "joint_names", "object", "environment_state_names", "action_meaning")
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")  # in the name of a robot
_OPTIONAL = ("object", "robot_type", "video", "keypoints")  # keys of a spec's JSON that may be missing


@dataclass(frozen=True)
class RobotTaskSpec:
    """Names, sizes and rate that a dataset, a policy and an environment must share.

    Names of robot, task and cameras are safe in paths. Raises `ManipError` naming an invalid value.
    """

    robot: str
    task: str
    fps: float  # control rate [Hz], an int if it is whole
    joint_names: tuple[str, ...]  # n: arm joints, then the gripper
    environment_state_names: tuple[str, ...]  # k
    sim_state_size: int  # m
    instruction: str  # LeRobot's `task` text

    action_meaning: str = OPENINGS
    cameras: tuple[str, ...] = ()
    image_size: tuple[int, int] = (0, 0)  # height, width [pixels] of every camera; (0, 0) without cameras
    phases: tuple[str, ...] = ()  # name of each value of `expert_phase`: "none", then the rungs of the task's ladder
    object: str = ""  # shape and size of the object that the task moves; empty for the task's own
    robot_type: str = ""  # LeRobot's name of the robot; empty if the same as `robot`
    video: bool = True  # whether pictures are in video files; otherwise they are PNGs in the data files
    keypoints: tuple[str, ...] = ()  # points of the scene whose image coordinates are columns, for every camera
    schema: int = VERSION

    def __post_init__(self) -> None:
        checks.name("robot", self.robot)
        checks.task_name(self.task)
        object.__setattr__(self, "fps", plain_rate(checks.number("fps", self.fps, 1)))
        checks.object_name(self.object)
        for camera in self.cameras:
            checks.name("a camera", camera)

    def to_json(self) -> dict[str, Any]:
        """Return the spec as JSON types, without optional keys that have their default."""
        values = {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}
        values |= {"video": None if self.video else False, "keypoints": list(self.keypoints) or None}
        return {key: value for key, value in values.items() if value not in ("", None) or key not in _OPTIONAL}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> RobotTaskSpec:
        """Return the spec that `to_json` wrote. Raises `ManipError` for an older schema, `TypeError` for other keys."""
        if (found := data.get("schema", 1)) != VERSION:
            raise ManipError(
                f"written with schema {checks.shorten(found)} of manip_il's columns, but this version reads {VERSION}; "
                "make it again in another folder, with the same options"
            )
        values: dict[str, Any] = {key: tuple(one) if isinstance(one, list) else one for key, one in data.items()}
        return cls(**values)

    @property
    def image_keys(self) -> dict[str, str]:
        """Columns of pictures: column -> camera."""
        return {IMAGES + camera: camera for camera in self.cameras}

    @property
    def keypoint_keys(self) -> dict[str, str]:
        """Columns of keypoints: column -> camera; {} if there are no keypoints."""
        return {KEYPOINTS + camera: camera for camera in self.cameras if self.keypoints}


def plain_rate(fps: float) -> float:
    """Return a rate as `info.json` has it: an int if it is whole."""
    return int(fps) if float(fps).is_integer() else fps


def exact_rate(fps: float) -> Fraction:
    """Return the fraction that a rate stands for, 2997/125 for 23.976; it fits the 32 bits of a video's time base."""
    return Fraction(str(fps)).limit_denominator(100_000)


def robot_of(robot_type: str) -> dict[str, str]:
    """Return the fields of `RobotTaskSpec` that LeRobot's `robot_type`, any text, determines."""
    if robot_type not in LEROBOT_TYPES:
        return {"robot": _UNSAFE.sub("_", robot_type), "robot_type": robot_type if _UNSAFE.search(robot_type) else ""}
    return {"robot": LEROBOT_TYPES[robot_type], "robot_type": robot_type, "action_meaning": SERVOS}


def features(spec: RobotTaskSpec) -> dict[str, dict[str, Any]]:
    """Return LeRobot's feature table for our columns (LeRobot adds its own index columns)."""
    joints, pictured = list(spec.joint_names), "video" if spec.video else "image"
    points = [f"{name}.{what}" for name in spec.keypoints for what in ("across", "down", "in_view")]
    pictures = {"dtype": pictured, "shape": (*spec.image_size, 3), "names": ["height", "width", "channels"]}
    return {
        STATE: _feature("float32", joints),
        ENVIRONMENT_STATE: _feature("float32", spec.environment_state_names),
        **{key: dict(pictures) for key in spec.image_keys},
        **{key: _feature("float32", points) for key in spec.keypoint_keys},
        ACTION: _feature("float32", joints),
        EXECUTED_ACTION: _feature("float32", joints),
        ACTOR: _feature("int64", ["actor"]),
        LABEL_VALID: _feature("int64", ["label_valid"]),
        EXPERT_PHASE: _feature("int64", ["phase"]),
        SIM_STATE: {"dtype": "float64", "shape": (spec.sim_state_size,), "names": None},
        PROGRESS: _feature("float32", ["progress"]),
        REWARD: _feature("float32", ["reward"]),
        SUCCESS: _feature("bool", ["success"]),
        DONE: _feature("bool", ["done"]),
        SEED: _feature("int64", ["seed"]),
        ROUND: _feature("int64", ["round"]),
        BETA: _feature("float32", ["beta"]),
    }


def _feature(dtype: str, names: Sequence[str]) -> dict[str, Any]:
    return {"dtype": dtype, "shape": (len(names),), "names": list(names)}


def check_same_spec(left_name: str, left: Any, right_name: str, right: RobotTaskSpec, also: Sequence[str] = ()) -> None:
    """Raise `MismatchError` unless actions and observations have the same meaning on both sides.

    The task may differ, so that a policy can be tried on another task. left: a spec, or an object with the same fields.
    also: other fields that must agree.
    """
    for what in (*MUST_AGREE, *also):
        ours, theirs = getattr(left, what), getattr(right, what)
        if ours != theirs:
            if what == "environment_state_names":  # the list is long: show only the first difference
                ours, theirs = next(pair for pair in zip_longest(ours, theirs) if pair[0] != pair[1])
            none = OWN_OBJECT if what == "object" else "none"
            raise MismatchError(what, left_name, ours or none, right_name, theirs or none)
