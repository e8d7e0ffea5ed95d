"""Action spaces that a policy may learn in, and the conversion to and from joint targets.

Let s = (q, w) be a frame's measured joints [rad] and gripper opening [m], a = (q*, w*) its action
(joint targets and commanded opening, as in datasets and environments), and (p, R) = FK(q) the
position and rotation of `ee`:

    joint_target   y = (q*, w*)
    joint_delta    y = (q* - q, w*)
    ee_delta       y = (p* - p, log(R* R^T), 0 ..., w*)      with (p*, R*) = FK(q*)

`joint_target` and `joint_delta` are lossless. The opening is absolute in all three: it is a
command, not a motion. With two arms there are two openings, each the last number of its arm.

`ee_delta` is a translation [m] and a rotation vector [rad] in the world frame, not the hand's:
objects and goals are observed in the world frame, so that a motion towards an object has the same
numbers for any orientation of the hand, and benchmarks (robosuite's OSC_POSE, gymnasium-robotics)
use the same convention. It is as long as the robot's action, so that the network's output fits the
environment; the numbers between the first six and the opening are 0 and are ignored. The arm needs
at least six joints, in [rad], not in degrees as those of robots whose YAML has `lerobot`. Decoding
finds q* near q with FK(q*) = (p + dp, exp(dR) R) (`ArmIK.moved`). It recovers the pose up to
rounding, but not the joints: an arm with seven joints can move its elbow without moving the hand,
which six numbers do not encode. As in the expert, a posture task that pulls towards the home
posture determines the elbow. If the pose is out of reach, the hand approaches it.

Each action is relative to the state measured at its own step: an action of a plan is converted at
the step in which it is executed, so that plans of many actions (ACT's chunks, diffusion's horizons)
are also converted exactly. Policies that learn plans are trained, for each frame of the window, on
the target minus the state of that frame.

`mlp` and `cnn` learn `joint_delta` by default. The network (`MLPNetwork`), which has the measured
joints as inputs anyway, adds them itself, so that an exported network needs no conversion; for
`joint_target` it adds nothing. All other conversions are in the checkpoint's processors
(`action_steps`): both deltas for LeRobot's policies, and `ee_delta` for every policy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from manip_il.caching import cached_per_thread
from manip_il.errors import MismatchError, UsageError
from manip_il.learn.names import EE_DELTA, JOINT_DELTA, JOINT_TARGET
from manip_il.robots.geometry import rotation_vector
from manip_il.robots.table import get_robot
from manip_il.worlds.contract import GRIPPERS, JOINT_TARGETS, EnvironmentSpec

if TYPE_CHECKING:  # importing inverse kinematics takes a second
    from manip_il.learn.checkpoint import Checkpoint
    from manip_il.robots.ik import ArmIK

LAST = (-1,)  # index of the gripper's opening, for a single arm
_ARM = slice(None, -1)  # joints of a single arm, in state and action
_POSITION = slice(0, 3)
_ROTATION = slice(3, 6)
_POSE = 6


@dataclass(frozen=True)
class Conversion:
    """Converts actions to the targets of a space and back, row by row.

    Attributes:
        space: One of `ACTION_SPACES`.
        robot: The arm, for `ee_delta` only.
        grippers: Indices of the gripper openings, which are absolute in `joint_delta`.

    Raises:
        UnknownName: The robot is unknown.
        UsageError: The arm has fewer than six joints, or its joints are in degrees.
    """

    space: str = JOINT_TARGET
    robot: str = ""
    grippers: tuple[int, ...] = LAST

    def __post_init__(self) -> None:
        if self.space != EE_DELTA:
            return
        robot = get_robot(self.robot)
        if (joints := len(robot.joints)) < _POSE or robot.lerobot is not None:
            raise UsageError(
                f"{EE_DELTA} needs an arm with at least {_POSE} joints [rad]; {self.robot} has"
                f" {joints}{' [deg]' if robot.lerobot else ''}; use {JOINT_DELTA}"
            )

    def encode(self, actions: NDArray[Any], states: NDArray[Any]) -> NDArray[Any]:
        """Convert actions (N, n), joint targets and openings, to this space, given measured
        joint states (N, n).
        """
        if self.space == JOINT_TARGET:
            return actions
        targets = actions.copy()
        if self.space == JOINT_DELTA:
            joints = self._joints(actions.shape[1])
            targets[:, joints] -= states[:, joints]
            return targets
        targets[:, _ARM], ik = 0, _arm_ik(self.robot)
        for target, action, state in zip(targets, actions, states, strict=True):
            position, rotation = ik.ee_pose(state[_ARM].astype(np.float64))
            wanted, turned = ik.ee_pose(action[_ARM].astype(np.float64))
            target[_POSITION] = wanted - position
            target[_ROTATION] = rotation_vector(turned @ rotation.T)
        return targets

    def decode(self, targets: NDArray[Any], states: NDArray[Any]) -> NDArray[Any]:
        """Convert targets (N, n) in this space to actions (N, n), joint targets and openings.

        Inverse of `encode`.
        """
        if self.space == JOINT_TARGET:
            return targets
        actions = targets.copy()
        if self.space == JOINT_DELTA:
            joints = self._joints(targets.shape[1])
            actions[:, joints] += states[:, joints]
            return actions
        joints = states[:, _ARM].astype(np.float64)
        motions = targets[:, :_POSE].astype(np.float64)
        actions[:, _ARM] = _arm_ik(self.robot).moved(joints, motions)
        return actions

    def _joints(self, n: int) -> NDArray[np.intp]:
        """Return the indices of the joints in an action of n numbers."""
        return np.delete(np.arange(n), self.grippers)


def conversion_for(
    space: str, spec: EnvironmentSpec, start: Checkpoint | None = None
) -> Conversion:
    """Return the conversion to an action space for the data of an environment.

    Args:
        space: One of `ACTION_SPACES`.
        spec: The specification of the environment or dataset.
        start: The checkpoint that a fit continues from, if any. It decides which numbers are
            gripper openings.

    Raises:
        MismatchError: The space is not `joint_target`, but the data's actions are not joint
            targets; or it is `ee_delta`, and the data's joint names are not the robot's.
        UnknownName: The robot is unknown, for `ee_delta`.
        UsageError: The arm has fewer than six joints, for `ee_delta`.
    """
    grippers = start.grippers if start is not None else GRIPPERS.get(spec.action_meaning, LAST)
    found = Conversion(space, spec.robot if space == EE_DELTA else "", grippers)
    if space != JOINT_TARGET and spec.action_meaning not in JOINT_TARGETS:
        needed = " or ".join(JOINT_TARGETS)
        raise MismatchError(
            "meaning of the action", "the dataset", spec.action_meaning, space, needed
        )
    if space == EE_DELTA and (names := get_robot(spec.robot).joint_names) != spec.joint_names:
        raise MismatchError(
            "list of joint names", "the dataset", spec.joint_names, f"robot {spec.robot}", names
        )
    return found


@cached_per_thread()
def _arm_ik(robot: str) -> ArmIK:
    from manip_il.robots.ik import ArmIK

    return ArmIK(get_robot(robot))
