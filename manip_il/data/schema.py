"""The columns of a dataset: keys, dtypes and shapes (LeRobot v3.0)."""

import re
from collections.abc import Sequence
from fractions import Fraction
from itertools import zip_longest
from typing import Any

from manip_il.errors import MismatchError
from manip_il.mdp import IMAGES as IMAGES
from manip_il.mdp import KEYPOINTS as KEYPOINTS
from manip_il.worlds.contract import SERVOS, EnvironmentSpec

STATE = "observation.state"
ENVIRONMENT_STATE = "observation.environment_state"
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
LEROBOT_TYPES = {"so_follower": "so101"}  # LeRobot's `robot_type` -> our name, if it differs
MOST_FPS = 10_000  # highest control rate [Hz]
MUST_AGREE = (
    "robot",
    "fps",
    "joint_names",
    "state_names",
    "object",
    "environment_state_names",
    "action_meaning",
)
_SCALARS = {  # column -> dtype
    **{PROGRESS: "float32", REWARD: "float32", SUCCESS: "bool", DONE: "bool"},
    **{SEED: "int64", ROUND: "int64", BETA: "float32"},
}
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")  # in the name of a robot


def exact_rate(fps: float) -> Fraction:
    """Return the fraction that a rate stands for, 2997/125 for 23.976.

    It fits the 32 bits of a video's time base.
    """
    return Fraction(str(fps)).limit_denominator(100_000)


def robot_of(robot_type: str) -> dict[str, str]:
    """Return the fields of `EnvironmentSpec` that LeRobot's `robot_type`, any text, determines."""
    if robot_type not in LEROBOT_TYPES:
        return {
            "robot": _UNSAFE.sub("_", robot_type),
            "robot_type": robot_type if _UNSAFE.search(robot_type) else "",
        }
    return {"robot": LEROBOT_TYPES[robot_type], "robot_type": robot_type, "action_meaning": SERVOS}


def features(spec: EnvironmentSpec) -> dict[str, dict[str, Any]]:
    """Return LeRobot's feature table for our columns (LeRobot adds its own index columns)."""
    joints, pictured = list(spec.joint_names), "video" if spec.video else "image"
    around = spec.environment_state_names
    points = [f"{name}.{what}" for name in spec.keypoints for what in ("across", "down", "in_view")]
    pictures = {
        "dtype": pictured,
        "shape": (*spec.image_size, 3),
        "names": ["height", "width", "channels"],
    }
    return {
        STATE: _feature("float32", spec.observed_names),
        **({ENVIRONMENT_STATE: _feature("float32", around)} if around else {}),
        **{key: dict(pictures) for key in spec.image_keys},
        **{key: _feature("float32", points) for key in spec.keypoint_keys},
        ACTION: _feature("float32", joints),
        EXECUTED_ACTION: _feature("float32", joints),
        ACTOR: _feature("int64", ["actor"]),
        LABEL_VALID: _feature("int64", ["label_valid"]),
        EXPERT_PHASE: _feature("int64", ["phase"]),
        SIM_STATE: {"dtype": "float64", "shape": (spec.sim_state_size,), "names": None},
        **{key: _feature(dtype, [key.removeprefix("next.")]) for key, dtype in _SCALARS.items()},
    }


def _feature(dtype: str, names: Sequence[str]) -> dict[str, Any]:
    return {"dtype": dtype, "shape": (len(names),), "names": list(names)}


def check_same_spec(
    left_name: str, left: Any, right_name: str, right: EnvironmentSpec, also: Sequence[str] = ()
) -> None:
    """Check that actions and observations have the same meaning on both sides.

    The task may differ, so that a policy can be tried on another task.

    Args:
        left_name: Name of the first side, for the message.
        left: Its spec, or an object with the same fields.
        right_name: Name of the second side, for the message.
        right: Its spec.
        also: Further fields that must agree.

    Raises:
        MismatchError: for the first field that differs.
    """
    for what in (*MUST_AGREE, *also):
        ours, theirs = getattr(left, what), getattr(right, what)
        if ours != theirs:
            # the list is long: show only the first difference
            if what == "environment_state_names":
                ours, theirs = next(
                    pair for pair in zip_longest(ours, theirs) if pair[0] != pair[1]
                )
            none = OWN_OBJECT if what == "object" else "none"
            raise MismatchError(what, left_name, ours or none, right_name, theirs or none)
