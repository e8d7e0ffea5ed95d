"""A gripper, described by the opening [m] between its pads: the parts of the fingertips that face
each other.

A sweep relates command and opening: when a robot is first used, its gripper is moved from closed to
open in steps, and the gap between the fingers is measured once they rest. Parallel, hinged and
linked fingers are thus treated alike.
"""

import bisect
import itertools
from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np

from manip_il.errors import UsageError
from manip_il.mdp import F64
from manip_il.robots.geometry import at_tip, distance, nearest
from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_spec

Geoms = Sequence[Sequence[int]]  # geom ids of each finger
TOUCH = 0.0015  # a finger this near to an object touches it [m]
_COMMANDS = 15  # commands of the sweep from closed to open
_SETTLE = 250  # physics steps at each command
_STEP = 0.002  # [s]
# a geom this much farther from the other finger than the nearest geom at the tip is no pad [m]
_PAD = 0.004
# if only one of two fingers moves, the middle of the pads moves by more than this [m]
_LOPSIDED = 0.004
_LEAST_TRAVEL = 0.005  # a gripper that opens by less grips nothing [m]


class Sweep(NamedTuple):
    """Measured relation between command and opening, at c commands.

    Attributes:
        shares: How far the driven joints are, or are commanded to be, from closed (0) to open (1);
            rising, (c,).
        openings: Gaps between the pads at these [m], rising, (c,).
        middles: Offsets along the hand's y of the midpoint between the pads [m], (c,); all 0 if
            both sides move alike.
        pads: For each finger, the places of its pads among the geoms of all fingers, nearest to
            the other finger first.
        holding: For each finger, the places of the geoms that may hold an object.
        linked: Positions of a linkage's undriven joints, by name, (c,).
    """

    shares: F64
    openings: F64
    middles: F64
    pads: tuple[tuple[int, ...], ...]
    holding: tuple[tuple[int, ...], ...]
    linked: Mapping[str, F64]


class Gripper:
    """A robot's gripper within a compiled model.

    Attributes:
        q: Indices of the g driven joints into `qpos`, (g,).
        ctrl: Indices of their actuators into `ctrl`, (g,).
        geoms: Ids of all geoms of the fingers that have contacts.
        pads: For each finger, the ids of its pads, nearest to the other finger first.
        lopsided: Whether one jaw is fixed, so that the midpoint between the pads moves.
        least: Opening of the closed gripper [m].
        most: Opening of the open gripper [m].
    """

    def __init__(self, robot: Robot, model: mujoco.MjModel, prefix: str = ""):
        """Find the gripper's joints, actuators and geoms in the model.

        Args:
            robot: The robot.
            model: A compiled model that contains the robot.
            prefix: Prefix of the robot's names in the model.

        Raises:
            UsageError: If the fingers do not come apart, or one has no geom with contacts.
        """
        config, self._sweep = robot.gripper, sweep(robot)
        self.q = np.array(
            [model.joint(prefix + name).qposadr[0] for name in config.joints], dtype=np.int64
        )
        self.ctrl = np.array(
            [model.actuator(prefix + name).id for name in config.joints], dtype=np.int64
        )
        self._closed = np.asarray(config.closed)
        self._travel = np.subtract(config.open, config.closed)
        # of the joints in how far the gripper is open, 0 to 1
        weights = 1 / (self._travel * len(self._travel))
        self._weights = tuple(zip(self.q.tolist(), weights.tolist(), strict=True))
        self._offset = float(weights @ self._closed)
        self._points = self._sweep.shares.tolist(), self._sweep.openings.tolist()
        self._linked = [
            (model.joint(prefix + name).qposadr[0], at) for name, at in self._sweep.linked.items()
        ]
        geoms = list(itertools.chain(*finger_geoms(model, config.fingers, prefix)))
        self.geoms = frozenset(geoms)
        self.pads, self._holding = (
            tuple(tuple(geoms[place] for place in finger) for finger in places)
            for places in (self._sweep.pads, self._sweep.holding)
        )
        self.lopsided = bool(self._sweep.middles.any())
        self.least, self.most = float(self._sweep.openings[0]), float(self._sweep.openings[-1])

    def opening(self, qpos: F64) -> float:
        """Return the opening between the pads [m]."""
        share = -self._offset
        for at, weight in self._weights:
            share += weight * qpos.item(at)
        shares, openings = self._points
        last = min(max(bisect.bisect_right(shares, share), 1), len(shares) - 1)
        along = min(max((share - shares[last - 1]) / (shares[last] - shares[last - 1]), 0.0), 1.0)
        return openings[last - 1] + along * (openings[last] - openings[last - 1])

    def command(self, opening: float) -> F64:
        """Return the actuators' commands for an opening [m], (g,)."""
        shares, openings = self._points
        return self._closed + float(np.interp(opening, openings, shares)) * self._travel

    def put(self, data: mujoco.MjData, opening: float) -> None:
        """Place the fingers, with their linkage if there is one, and command them to stay there.

        Args:
            data: Data of the gripper's model, changed in place.
            opening: Opening of the gripper [m].
        """
        data.qpos[self.q] = data.ctrl[self.ctrl] = self.command(opening)
        for at, positions in self._linked:
            data.qpos[at] = np.interp(opening, self._sweep.openings, positions)

    @property
    def driven(self) -> tuple[F64, F64]:
        """Openings [m], rising, and the first driven joint's positions at these [rad or m].

        Both (c,).
        """
        return self._sweep.openings, self._closed[0] + self._sweep.shares * self._travel[0]

    def middle(self, opening: float) -> float:
        """Return the offset [m] of the midpoint between the pads along the hand's y.

        It is 0 if all fingers move. If one jaw is fixed and the other turns or slides, a held
        object ends up beside the fixed one.

        Args:
            opening: Opening of the gripper [m].
        """
        if not self.lopsided:
            return 0.0
        return float(np.interp(opening, self._sweep.openings, self._sweep.middles))

    def commanded(self, commands: F64) -> float:
        """Return the opening [m] that the first of the driven joints' commands (g,) asks for."""
        share = (commands[0] - self._closed[0]) / self._travel[0]
        return float(np.interp(share, self._sweep.shares, self._sweep.openings))

    def touches(self, model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> bool:
        """Return whether every finger touches a geom.

        Args:
            model: The compiled model.
            data: Its data, with up-to-date kinematics.
            geom: Id of the geom.
        """
        # For two separate boxes `mj_geomDistance` sometimes returns 0, but only if they are nearer
        # than `TOUCH`.
        return all(
            any(mujoco.mj_geomDistance(model, data, pad, geom, TOUCH, None) < TOUCH for pad in pads)
            for pads in self._holding
        )


@cache
def sweep(robot: Robot) -> Sweep:
    """Move a robot's gripper from closed to open and measure where the fingers come to rest.

    Raises:
        UsageError: If the fingers touch when open, or do not come apart.
    """
    spec = arm_spec(robot)
    set_time_step(spec)
    model = spec.compile()
    data, config = mujoco.MjData(model), robot.gripper
    for name, value in zip(robot.joints, robot.home, strict=True):
        data.joint(name).qpos[0] = data.actuator(name).ctrl[0] = value
    fingers = finger_geoms(model, config.fingers)
    shares, poses = _shares_at_rest(robot, model, data)

    def gaps_at(pose: F64, groups: Geoms) -> list[F64]:
        """For each group, the distances [m] from its geoms to the nearest geom of another group."""
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        gaps = []
        for own in groups:
            others = list(itertools.chain(*(group for group in groups if group is not own)))
            gaps.append(
                np.array([min(distance(model, data, geom, far) for far in others) for geom in own])
            )
        return gaps

    # Geoms that touch no other finger when open: this leaves out those around a jaw's hinge.
    jaws = [
        [geom for geom, gap in zip(*finger, strict=True) if gap > 0]
        for finger in zip(fingers, gaps_at(poses[-1], fingers), strict=True)
    ]
    if not all(jaws):
        raise UsageError(
            f"robot {robot.name}: the fingers touch when open; check gripper.open and"
            " gripper.fingers"
        )
    # Of these, the geoms near the tips; the links behind them may pass beside the other finger's.
    hand = data.site("ee")
    tips = [at_tip(model, data, jaw, hand.xmat.reshape(3, 3)[:, 2]) for jaw in jaws]
    gaps = [gaps_at(pose, tips) for pose in poses]
    touching = [place for place, groups in enumerate(gaps) if min(gap.min() for gap in groups) <= 0]
    shut = max(touching, default=0)
    least = [gap.min() for gap in gaps[shut]]
    pads = list(map(_near, gaps[shut], tips, least))
    shares, poses = shares[shut:], poses[shut:]
    openings, middles = list[float](), list[float]()
    for pose in poses:
        openings.append(float(min(gap.min() for gap in gaps_at(pose, pads))))
        middle = nearest(model, data, pads)[1].mean(axis=0) - hand.xpos
        middles.append(float(hand.xmat.reshape(3, 3)[:, 1] @ middle))
    driven = {*robot.joints, *config.joints}
    others = [joint for joint in map(model.joint, range(model.njnt)) if joint.name not in driven]
    linked = {joint.name: np.array([pose[joint.qposadr[0]] for pose in poses]) for joint in others}
    growth = np.minimum(np.diff(openings), np.diff(shares))
    if openings[-1] - openings[0] < _LEAST_TRAVEL or growth.min() <= 0:
        place = int((growth <= 0).argmax())  # the first step without growth
        span = config.closed[0], config.open[0]
        start, end = np.interp(shares[place : place + 2], [0, 1], span)
        raise UsageError(
            f"robot {robot.name}: the fingers stand {openings[0]:.4f} m apart when closed,"
            f" {openings[-1]:.4f} m when open, and go from {openings[place]:.4f} to"
            f" {openings[place + 1]:.4f} m as {config.joints[0]} goes from {start:.3f} to"
            f" {end:.3f}; expected the gap to grow all the way: check gripper.joints (undriven:"
            f" {', '.join(linked) or 'none'}), closed, open and fingers"
        )
    holding = jaws  # a turning jaw holds wide objects farther from its tip
    if np.ptp(middles) < _LOPSIDED:
        middles = [0.0] * len(middles)
        holding = list(map(_near, gaps_at(poses[0], jaws), jaws, least))
    geoms = list(itertools.chain(*fingers))
    places = [tuple(tuple(map(geoms.index, finger)) for finger in some) for some in (pads, holding)]
    return Sweep(np.array(shares), np.array(openings), np.array(middles), *places, linked=linked)


def set_time_step(spec: mujoco.MjSpec) -> None:
    """Set a time step and an integrator that stiff linkages bear.

    They are for a gripper that is simulated alone.
    """
    spec.option.timestep, spec.option.integrator = _STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def _shares_at_rest(
    robot: Robot, model: mujoco.MjModel, data: mujoco.MjData
) -> tuple[list[float], list[F64]]:
    """For each command from closed to open, the share of the way that is reached, and `qpos`."""
    config = robot.gripper
    q = np.array([model.joint(name).qposadr[0] for name in config.joints])
    ctrl = np.array([model.actuator(name).id for name in config.joints])
    closed, travel = np.asarray(config.closed), np.subtract(config.open, config.closed)
    data.qpos[q] = closed
    shares, poses = list[float](), list[F64]()
    for share in np.linspace(0, 1, _COMMANDS):
        data.ctrl[ctrl] = closed + share * travel
        mujoco.mj_step(model, data, _SETTLE)
        shares.append(float(((data.qpos[q] - closed) / travel).mean()))
        poses.append(data.qpos.copy())
    return shares, poses


def _near(gaps: F64, geoms: Sequence[int], least: float) -> list[int]:
    """The geoms whose gap exceeds `least` by at most `_PAD`, nearest first."""
    return [geoms[i] for i in np.argsort(gaps, kind="stable") if gaps[i] <= least + _PAD]


def finger_geoms(
    model: mujoco.MjModel, fingers: Sequence[str], prefix: str = ""
) -> list[tuple[int, ...]]:
    """Find the geoms with contacts on each finger's body and on that body's descendants.

    A descendant that is another finger is left out.

    Args:
        model: A compiled model.
        fingers: Names of the fingers' bodies, without the prefix.
        prefix: Prefix of the bodies' names in the model.

    Returns:
        For each finger, the ids of its geoms, rising.

    Raises:
        UsageError: If a finger has no such geom.
    """
    owners = {model.body(prefix + name).id: place for place, name in enumerate(fingers)}
    for body in range(1, model.nbody):
        owners.setdefault(body, owners.get(int(model.body_parentid[body]), -1))
    found: list[list[int]] = [[] for _ in fingers]
    for geom, body in enumerate(model.geom_bodyid.tolist()):
        if owners.get(body, -1) >= 0 and (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            found[owners[body]].append(geom)
    if not all(found):
        name = fingers[found.index([])]
        raise UsageError(f"finger {name!r} has no geom with contacts; expected at least one")
    return list(map(tuple, found))
