"""A first draft of the YAML for a robot's MJCF: the hand's body, the joints that drive the fingers, and a workspace."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from manip_il.errors import UsageError
from manip_il.robots.files import ModelFiles
from manip_il.robots.geometry import nearest
from manip_il.robots.gripper import finger_geoms
from manip_il.robots.spec import load

_ARM_GOES_ON = 3  # a branch with this many joints in series belongs to the arm: a finger has fewer
_JAWS = ("jaw", "finger", "grip", "claw")  # words in the name of a single jaw's body or joint
_HANDS = ("hand", "flange", "attachment", "tool", "gripper", "ee", "tcp")  # words in the name of a gripper's mount
_REACHES, _HALF = 0.5, 0.18  # distance of the workspace's centre from the base, and its half width, in arm lengths
_WIDEST, _HIGHEST = 0.15, 0.45  # largest half width and height of a workspace [m]
_ROUND = 0.01  # what lengths are rounded to [m]
_FIRST_LINE = (
    "# A first draft, derived from the model. Review it: manip-il view --robot.type=THIS_FILE (docs/robots.md)"
)
_NOTES = {
    "hand": "body that carries the gripper",
    "joints": "joints that drive the fingers",
    "closed": "their positions when closed, [m] if they slide, [rad] if they turn",
    "fingers": "bodies that touch objects",
    "centre": "on the table, x away from the base [m]",
}


def suggest(model: Path, gripper: Path | None = None) -> dict[str, Any]:
    """Inspect a robot's MJCF, and its gripper's if there is one; return the content of a YAML, without paths.

    Raises `UsageError` if MuJoCo cannot read or compile them, or if no hand or no fingers are found.
    """
    files = [ModelFiles(path.absolute()) for path in (model, gripper) if path is not None]
    spec, with_jaws = load(files[0], model.stem), load(files[-1], model.stem)
    palm, jaws = _palm(with_jaws, gripper or model)
    hand, driven = palm if gripper is None else _flange(spec.worldbody), _driven(with_jaws, jaws, gripper or model)
    try:
        closed, opened, fingers = _ends(with_jaws, palm, jaws, driven)
        length, base = _length(spec, hand.name)
    except ValueError as error:
        raise UsageError(f"MuJoCo cannot compile {gripper or model}: {' '.join(str(error).split())}") from None
    return {
        "hand": hand.name,
        "gripper": {
            "joints": [joint.name for joint in driven],
            "closed": closed,
            "open": opened,
            "fingers": list(fingers),
        },
        "workspace": {
            "centre": [_rounded(base[0] + _REACHES * length), _rounded(base[1])],
            "half_width": _rounded(min(_WIDEST, _HALF * length)),
            "height": _rounded(min(_HIGHEST, 3 * _HALF * length)),
        },
    }


def _depth(body: Any) -> int:
    """Largest number of joints in series from a body outwards."""
    return len(body.joints) + max((_depth(child) for child in body.bodies), default=0)


def _palm(spec: mujoco.MjSpec, path: Path) -> tuple[Any, list[Any]]:
    """The body at which the chain of joints branches into fingers, and the first body of each; one jaw is enough."""
    body = spec.worldbody
    while True:
        moving = [child for child in body.bodies if _depth(child)]
        longest = max(moving, key=_depth, default=None)
        if longest is None:
            break
        if len(moving) > 1 and _depth(longest) < _ARM_GOES_ON:
            return body, moving
        body = longest
    if body.joints and any(word in f"{body.name} {body.joints[0].name}".lower() for word in _JAWS):
        return body.parent, [body]
    raise UsageError(
        f"{path}: its joints do not branch into fingers, and its last body, {body.name!r}, is not named like a jaw;"
        " if the gripper has a model of its own, give it with --gripper=PATH"
    )


def _flange(body: Any) -> Any:
    """The body that a gripper is mounted on: the last of the chain, or one fixed to it with a name in `_HANDS`."""
    while True:
        moving = [child for child in body.bodies if _depth(child)]
        if not moving:
            break
        body = max(moving, key=_depth)
    named = [one for one in body.find_all("body") if any(word in one.name.lower() for word in _HANDS)]
    return named[-1] if named else body


def _driven(spec: mujoco.MjSpec, jaws: Sequence[Any], path: Path) -> list[Any]:
    """The finger joints to drive: those that slide, else those with motors, else those next to the hand."""
    joints = [joint for jaw in jaws for joint in (*jaw.joints, *(one for one in jaw.find_all("joint")))]
    joints = list({joint.name: joint for joint in joints}.values())
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
            f"{path}: no joint with a name and a range moves the fingers; write the YAML by hand (docs/robots.md)"
        )
    return driven


def _ends(
    spec: mujoco.MjSpec, palm: Any, jaws: Sequence[Any], driven: Sequence[Any]
) -> tuple[list[float], list[float], Sequence[str]]:
    """Find each driven joint's closed and open positions, by the fingers' distance, and the bodies that touch."""
    moving = [
        jaw.name
        for jaw in jaws
        if {joint.name for joint in (*jaw.joints, *jaw.find_all("joint"))} & {j.name for j in driven}
    ]
    bodies = moving if len(moving) > 1 else [palm.name, *moving]
    ranges = [tuple(float(end) for end in joint.range) for joint in driven]
    model = spec.compile()
    data, fingers = mujoco.MjData(model), finger_geoms(model, bodies)
    opposed = [[one, *(other for other in fingers if other is not one)] for one in fingers]

    def gap(values: Sequence[float]) -> float:
        for joint, value in zip(driven, values, strict=True):
            data.joint(joint.name).qpos[0] = value
        mujoco.mj_kinematics(model, data)
        ends = np.array([nearest(model, data, groups)[1] for groups in opposed])
        centres = np.array([np.mean(data.geom_xpos[list(finger)], axis=0) for finger in fingers])
        apart = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean()
        return float(apart + np.linalg.norm(centres - centres.mean(axis=0), axis=1).sum())

    middle = [sum(ends) / 2 for ends in ranges]
    opened, closed = list(middle), list(middle)
    for place, ends in enumerate(ranges):
        gaps = [gap([*middle[:place], end, *middle[place + 1 :]]) for end in ends]
        opened[place], closed[place] = ends if gaps[0] > gaps[1] else ends[::-1]
    gap(closed)
    pads = nearest(model, data, fingers)[0]
    touching = [model.body(model.geom_bodyid[pad]).name for pad in pads]
    closed, opened = ([float(f"{one:.5g}") + 0.0 for one in ends] for ends in (closed, opened))  # no -0
    return closed, opened, touching if len(moving) > 1 else bodies


def _length(spec: mujoco.MjSpec, hand: str) -> tuple[float, tuple[float, float]]:
    """Length of the arm from its second joint to the hand [m], and where its base stands, x and y [m]."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body, places = model.body(hand).id, [data.xpos[model.body(hand).id]]
    while body:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        places += [data.xanchor[joint] for joint in range(first, first + count)]
        body = int(model.body_parentid[body])
    steps = [float(np.linalg.norm(a - b)) for a, b in itertools.pairwise(places)]
    return sum(steps[:-1]), (float(places[-1][0]), float(places[-1][1]))


def _rounded(length: float) -> float:
    return round(round(length / _ROUND) * _ROUND, 3)


def yaml_of(found: Mapping[str, Any], model: str, gripper: str = "") -> str:
    """Return what `suggest` found as YAML text, with comments. model, gripper: their paths, as written to the YAML."""
    own = {"model": gripper} if gripper else {}
    tree = {"model": model, **found, "gripper": own | found["gripper"]}
    text = yaml.safe_dump(tree, default_flow_style=None, width=math.inf, sort_keys=False)
    for key, note in _NOTES.items():
        text = re.sub(rf"(?m)^( *{key}:.*)$", lambda line, note=note: f"{line[1]} # {note}", text, count=1)
    return f"{_FIRST_LINE}\n{text}"
