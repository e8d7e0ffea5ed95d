"""A first draft of the YAML for a robot's MJCF: the hand's body, the joints that drive the
fingers, and a workspace.
"""

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from manip_il.checks import one_line
from manip_il.errors import UsageError
from manip_il.robots.files import ModelFiles
from manip_il.robots.geometry import nearest
from manip_il.robots.gripper import finger_geoms
from manip_il.robots.spec import joint_range, load

_ARM_GOES_ON = 3  # a branch with this many joints in series belongs to the arm: a finger has fewer
_JAWS = ("jaw", "finger", "grip", "claw")  # words in the name of a single jaw's body or joint
# words in the name of a gripper's mount
_HANDS = ("hand", "flange", "attachment", "tool", "gripper", "ee", "tcp")
# distance of the workspace's centre from the base, and its half width, in arm lengths
_REACHES, _HALF = 0.5, 0.18
_WIDEST, _HIGHEST = 0.15, 0.45  # largest half width and height of a workspace [m]
_YAML = """\
# A first draft, derived from the model (docs/robots.md). Review it:
# manip-il view --robot.type=THIS_FILE
model: {model}
hand: {hand} # body that carries the gripper
gripper:{own}
  joints: {joints} # joints that drive the fingers
  closed: {closed} # their positions when closed, [m] if they slide, [rad] if they turn
  open: {open}
  fingers: {fingers} # bodies that touch objects
workspace:
  centre: {centre} # on the table, x away from the base [m]
  half_width: {half_width}
  height: {height}
"""


def suggest(model: Path, gripper: Path | None = None) -> dict[str, Any]:
    """Draft the content of a YAML, without paths, from a robot's MJCF.

    Args:
        model: Path of the robot's MJCF.
        gripper: Path of the gripper's MJCF, if it has one of its own.

    Returns:
        The keys `hand`, `gripper` and `workspace` with their values.

    Raises:
        UsageError: If MuJoCo cannot read or compile a file, or if no hand or no fingers are found.
    """
    last = gripper or model
    spec, with_jaws = (load(ModelFiles(path.absolute()), model.stem) for path in (model, last))
    palm, jaws = _palm(with_jaws, last)
    hand = palm if gripper is None else _flange(spec.worldbody)
    driven = _driven(with_jaws, jaws, last)
    try:
        fingers = _ends(with_jaws, palm, jaws, driven)
        return {
            "hand": hand.name,
            "gripper": fingers,
            "workspace": _workspace(spec.compile(), hand.name),
        }
    except ValueError as error:
        raise UsageError(f"MuJoCo cannot compile {last}: {one_line(error)}") from None


def _depth(body: Any) -> int:
    """Largest number of joints in series from a body outwards."""
    return len(body.joints) + max((_depth(child) for child in body.bodies), default=0)


def _palm(spec: mujoco.MjSpec, path: Path) -> tuple[Any, list[Any]]:
    """The body at which the chain of joints branches into fingers, and the first body of each.

    One jaw is enough.
    """
    body = spec.worldbody
    while moving := [child for child in body.bodies if _depth(child)]:
        longest = max(moving, key=_depth)
        if len(moving) > 1 and _depth(longest) < _ARM_GOES_ON:
            return body, moving
        body = longest
    if body.joints and any(word in f"{body.name} {body.joints[0].name}".lower() for word in _JAWS):
        return body.parent, [body]
    raise UsageError(
        f"{path}: its joints do not branch into fingers, and its last body, {body.name!r}, is not"
        " named like a jaw; if the gripper has a model of its own, give it with --gripper=PATH"
    )


def _flange(body: Any) -> Any:
    """The body that a gripper is mounted on: the last of the chain, or one fixed to it with a
    name in `_HANDS`.
    """
    while moving := [child for child in body.bodies if _depth(child)]:
        body = max(moving, key=_depth)
    named = [
        part for part in body.find_all("body") if any(word in part.name.lower() for word in _HANDS)
    ]
    return named[-1] if named else body


def _driven(spec: mujoco.MjSpec, jaws: Sequence[Any], path: Path) -> list[Any]:
    """The finger joints to drive: those that slide, else those with motors, else those next to
    the hand.
    """
    joints = [joint for jaw in jaws for joint in jaw.find_all("joint")]
    slides = [joint for joint in joints if joint.type == mujoco.mjtJoint.mjJNT_SLIDE]
    motors = {motor.target for motor in spec.actuators}
    motored = [joint for joint in joints if joint.name in motors]
    most = max((_depth(jaw) for jaw in jaws), default=0)
    next_to_hand = [jaw.joints[0] for jaw in jaws if jaw.joints and _depth(jaw) == most]
    coupled = {name for equality in spec.equalities for name in (equality.name1, equality.name2)}
    in_step = [joint for joint in next_to_hand if joint.name in coupled]
    driven = slides or motored or in_step or next_to_hand
    if not driven or not all(joint.name and joint.range[0] < joint.range[1] for joint in driven):
        raise UsageError(
            f"{path}: no joint with a name and a range moves the fingers; write the YAML by hand"
            " (docs/robots.md)"
        )
    return driven


def _ends(
    spec: mujoco.MjSpec, palm: Any, jaws: Sequence[Any], driven: Sequence[Any]
) -> dict[str, Any]:
    """Find each driven joint's closed and open positions, by the fingers' distance, and the
    bodies that touch.
    """
    names = {joint.name for joint in driven}
    moving = [
        jaw.name
        for jaw in jaws
        if not names.isdisjoint(joint.name for joint in jaw.find_all("joint"))
    ]
    bodies = moving if len(moving) > 1 else [palm.name, *moving]
    ranges = [joint_range(joint).tolist() for joint in driven]
    middle = [sum(ends) / 2 for ends in ranges]
    model = spec.compile()
    data, fingers = mujoco.MjData(model), finger_geoms(model, bodies)
    opposed = [[one, *(other for other in fingers if other is not one)] for one in fingers]
    q = [model.joint(joint.name).qposadr[0] for joint in driven]

    def gap(place: int, end: float) -> float:
        data.qpos[q] = [*middle[:place], end, *middle[place + 1 :]]
        mujoco.mj_kinematics(model, data)
        ends = np.array([nearest(model, data, groups)[1] for groups in opposed])
        centres = np.array([np.mean(data.geom_xpos[list(finger)], axis=0) for finger in fingers])
        apart = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean()
        return float(apart + np.linalg.norm(centres - centres.mean(axis=0), axis=1).sum())

    sides = [sorted(ends, key=partial(gap, place)) for place, ends in enumerate(ranges)]
    if len(moving) > 1:
        data.qpos[q] = [closed for closed, _ in sides]
        mujoco.mj_kinematics(model, data)
        bodies = [
            model.body(model.geom_bodyid[pad]).name for pad in nearest(model, data, fingers)[0]
        ]
    # no -0
    closed, opened = (
        [float(f"{end:.5g}") + 0.0 for end in ends] for ends in zip(*sides, strict=True)
    )
    return {
        "joints": [joint.name for joint in driven],
        "closed": closed,
        "open": opened,
        "fingers": bodies,
    }


def _workspace(model: mujoco.MjModel, hand: str) -> dict[str, Any]:
    """Propose a workspace, given the arm's length from its second joint to the hand and where
    its base is.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body = model.body(hand).id
    places = [data.xpos[body]]
    while body:
        first = int(model.body_jntadr[body])
        places += list(data.xanchor[first : first + int(model.body_jntnum[body])])
        body = int(model.body_parentid[body])
    length = float(np.linalg.norm(np.diff(places[:-1], axis=0), axis=1).sum())
    x, y, _ = places[-1].tolist()
    return {
        "centre": [_to_centimetres(x + _REACHES * length), _to_centimetres(y)],
        "half_width": _to_centimetres(min(_WIDEST, _HALF * length)),
        "height": _to_centimetres(min(_HIGHEST, 3 * _HALF * length)),
    }


def _to_centimetres(length: float) -> float:
    return round(length / 0.01) / 100


def yaml_of(found: Mapping[str, Any], model: str, gripper: str = "") -> str:
    """Return what `suggest` found as YAML text, with comments.

    Args:
        found: The result of `suggest`.
        model: Path of the robot's MJCF, as written to the YAML.
        gripper: Path of the gripper's MJCF, as written to the YAML; empty if it has none of its
            own.
    """
    values = {"model": model, "hand": found["hand"], **found["gripper"], **found["workspace"]}
    # JSON is YAML
    words = {key: json.dumps(value, ensure_ascii=False) for key, value in values.items()}
    return _YAML.format(own=f"\n  model: {json.dumps(gripper)}" if gripper else "", **words)
