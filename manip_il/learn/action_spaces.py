"""The spaces in which a policy may learn a robot's action, and the way there and back.

With s = (q, w) the measured joints [rad] and gripper opening [m] of a frame, a = (q*, w*) its action (joint targets and
the opening's command, what a dataset holds and an environment takes), and (p, R) = FK(q) position and rotation of `ee`:

    joint_target   y = (q*, w*)
    joint_delta    y = (q* - q, w*)
    ee_delta       y = (p* - p, log(R* R^T), 0 ..., w*)      with (p*, R*) = FK(q*)

`joint_target` and `joint_delta` lose nothing. The opening is absolute in all: it is a command to close, not a motion.

`ee_delta` is a position [m] and a rotation vector [rad] in the world's axes, not the hand's: objects and goals are
observed there, so that "towards it" is the same numbers however the hand is turned, and stock environments
(robosuite's OSC_POSE, gymnasium-robotics) mean the same by it. It has as many numbers as the robot's action, so that a
network has the environment's shape; those between the six and the opening are 0 and are not read. Six numbers need an
arm of six joints or more. The way back finds q* near q with FK(q*) = (p + dp, exp(dR) R) (`ArmIK.moved`). The pose is
reached again to rounding, the joints are not: an arm of seven joints has a motion of the elbow that leaves the hand
where it is, which six numbers do not hold. It is chosen as the expert chooses it, by the pull to the home posture. A
pose out of reach is approached.

The measured state is the frame's own. An action of a plan is thus converted in the step in which it is executed, with
the joints measured there, so that plans of many actions (ACT's chunks, diffusion's horizons) are converted exactly,
too; what learns them sees target minus state of each frame of the window.

Robots whose YAML says `lerobot` have degrees and 0 to 100 in s and a; their hand's motion is in [m] and [rad], too.

`mlp` and `cnn` learn `joint_delta` by default, inside of their network (`MLPNetwork`), which holds the measured joints
anyway and so goes into an exported file whole; `joint_target` is the same network without the sum. What a network
cannot hold is in the checkpoint's processors (`action_steps`): both deltas of LeRobot's policies, every `ee_delta`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from manip_il.data.schema import JOINT_TARGETS, RobotTaskSpec
from manip_il.errors import MismatchError, UnknownName, UsageError
from manip_il.learn.names import ACTION_SPACES, EE_DELTA, JOINT_DELTA, JOINT_TARGET
from manip_il.robots import ROBOTS
from manip_il.robots.rotations import rotation_vector

if TYPE_CHECKING:  # inverse kinematics takes a second to import
    from manip_il.robots.ik import ArmIK
    from manip_il.robots.robot import Robot

ARM, GRIPPER = slice(None, -1), -1  # of joint state and action, as every robot's `ActionSpace` orders them
_POSITION, _ROTATION, _POSE = slice(0, 3), slice(3, 6), 6
Numbers = TypeVar("Numbers", bound=np.floating[Any])


@dataclass(frozen=True)
class Conversion:
    """The way from actions to targets of a space and back, row by row. robot: whose hand moves, of `ee_delta` alone.

    Raises `UnknownName` for a space or robot, `UsageError` for an arm that has fewer joints than a pose has numbers.
    """

    space: str = JOINT_TARGET
    robot: str = ""

    def __post_init__(self) -> None:
        if self.space not in ACTION_SPACES:
            raise UnknownName("action space", self.space, ACTION_SPACES)
        if self.space != EE_DELTA:
            return
        if self.robot not in ROBOTS:  # no path either: the name may be a downloaded checkpoint's
            hint = f"{EE_DELTA} needs its kinematics; known: {', '.join(ROBOTS)}"
            raise UnknownName("robot", self.robot, ROBOTS, hint)
        if (joints := len(self._robot.joints)) < _POSE:
            raise UsageError(
                f"{EE_DELTA} has {_POSE} numbers, and the arm of {self.robot} {joints} joints; use {JOINT_DELTA}"
            )

    def encode(self, actions: NDArray[Numbers], states: NDArray[Any]) -> NDArray[Numbers]:
        """Return targets (N, n) of joint targets and openings (N, n), measured from joint states (N, n)."""
        if self.space == JOINT_TARGET:
            return actions
        targets = actions.copy()
        if self.space == JOINT_DELTA:
            targets[:, ARM] -= states[:, ARM]
            return targets
        targets[:, ARM], ik = 0, _arm_ik(self.robot)
        for target, action, state in zip(targets, actions, states, strict=True):
            position, rotation = ik.ee_pose(self._to_radians(state[ARM]))
            wanted, turned = ik.ee_pose(self._to_radians(action[ARM]))
            target[_POSITION], target[_ROTATION] = wanted - position, rotation_vector(turned @ rotation.T)
        return targets

    def decode(self, targets: NDArray[Numbers], states: NDArray[Any]) -> NDArray[Numbers]:
        """Return joint targets [rad] and openings [m] (N, n) of targets (N, n), measured from joint states (N, n)."""
        if self.space == JOINT_TARGET:
            return targets
        actions = targets.copy()
        if self.space == JOINT_DELTA:
            actions[:, ARM] += states[:, ARM]
            return actions
        motions = targets[:, :_POSE].astype(np.float64)
        joints = _arm_ik(self.robot).moved(self._to_radians(states[:, ARM]), motions)
        actions[:, ARM] = np.degrees(joints) if self._robot.lerobot is not None else joints
        return actions

    def _to_radians(self, joints: NDArray[Any]) -> NDArray[np.float64]:
        """Joints (..., n - 1) [rad] in double precision of an action's or a state's."""
        in_degrees = self._robot.lerobot is not None
        return np.radians(joints, dtype=np.float64) if in_degrees else np.asarray(joints, np.float64)

    @property
    def _robot(self) -> Robot:
        from manip_il.robots.table import get_robot

        return get_robot(self.robot)


def conversion_for(space: str, spec: RobotTaskSpec) -> Conversion:
    """Return the conversion of a space for data of `spec`.

    Raises `MismatchError` naming both sides if the data's actions are not joint targets of a robot that is known
    here with these joints, if that matters, and what `Conversion` raises.
    """
    found = Conversion(space, spec.robot if space == EE_DELTA else "")
    if space != JOINT_TARGET and spec.action_meaning not in JOINT_TARGETS:
        needed = " or ".join(JOINT_TARGETS)
        raise MismatchError("meaning of the action", "the dataset", spec.action_meaning, space, needed)
    if space == EE_DELTA and (names := found._robot.joint_names) != spec.joint_names:
        raise MismatchError("joint names", "the dataset", spec.joint_names, f"robot {spec.robot}", names)
    return found


@cache
def _arm_ik(robot: str) -> ArmIK:
    from manip_il.robots.ik import ArmIK
    from manip_il.robots.table import get_robot

    return ArmIK(get_robot(robot))
