"""The one list of a dataset's columns: keys, dtypes, shapes, meaning (LeRobot v3.0)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

STATE = "observation.state"
ENVIRONMENT_STATE = "observation.environment_state"
ACTION = "action"
EXECUTED_ACTION = "executed_action"
ACTOR = "actor"
LABEL_VALID = "label_valid"
EXPERT_PHASE = "expert_phase"
SIM_STATE = "sim_state"
REWARD = "next.reward"
SUCCESS = "next.success"
DONE = "next.done"
SEED = "seed"
ROUND = "round"
BETA = "beta"


@dataclass(frozen=True)
class RobotTaskSpec:
    """What a dataset is about: names, sizes and rate that dataset, policy and environment must share."""

    robot: str
    task: str
    fps: int  # control steps a second
    joint_names: tuple[str, ...]  # n: arm joints, then the gripper
    environment_state_names: tuple[str, ...]  # k
    sim_state_size: int  # m
    instruction: str  # LeRobot's `task` text

    action_meaning: str = "joint position targets [rad], gripper opening command [m]"


def features(spec: RobotTaskSpec) -> dict[str, dict[str, Any]]:
    """LeRobot's feature table for our columns (LeRobot adds its own index columns)."""
    joints = list(spec.joint_names)
    return {
        STATE: _feature("float32", joints),
        ENVIRONMENT_STATE: _feature("float32", spec.environment_state_names),
        ACTION: _feature("float32", joints),
        EXECUTED_ACTION: _feature("float32", joints),
        ACTOR: _feature("int64", ["actor"]),
        LABEL_VALID: _feature("int64", ["label_valid"]),
        EXPERT_PHASE: _feature("int64", ["phase"]),
        SIM_STATE: {"dtype": "float64", "shape": (spec.sim_state_size,), "names": None},
        REWARD: _feature("float32", ["reward"]),
        SUCCESS: _feature("bool", ["success"]),
        DONE: _feature("bool", ["done"]),
        SEED: _feature("int64", ["seed"]),
        ROUND: _feature("int64", ["round"]),
        BETA: _feature("float32", ["beta"]),
    }


def _feature(dtype: str, names: Sequence[str]) -> dict[str, Any]:
    return {"dtype": dtype, "shape": (len(names),), "names": list(names)}
