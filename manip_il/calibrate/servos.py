"""The parameters of an arm's servos, from recorded goals and positions alone.

The whole arm is simulated in MuJoCo with the servos of `sim.servo`, so that weight and coupling of
the joints are in it. Least squares with a wide prior around the default servos finds the parameters
(Gauss-Newton; a joint's errors are taken to depend on its own servo). The intervals hold although
errors of neighbouring moments are alike: the scores are summed over blocks of time (the sandwich
estimate of White 1982 and Liang & Zeger 1986).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray
from scipy import stats

from manip_il.data.dataset import Dataset
from manip_il.errors import ManipError, MismatchError, NotFiniteError, UsageError
from manip_il.mdp import F64, I64
from manip_il.robots.robot import Robot
from manip_il.robots.servos import BOUNDS, FACTORY_GAIN, GAIN, PARAMETERS, default_servo
from manip_il.sim.config import MOST_HZ
from manip_il.sim.servo import dofs_of, follow, set_joints, set_motors
from manip_il.sim.world import Scene

# How far servos may be from the default ones, as the standard deviation of the prior: factors
# e^-0.7 to e^0.7 (0.5 to 2), or what is added.
FACTOR = 0.7
ADDED = {"play": 1.0, "delay": 0.03, "friction": 0.2}
TOLD = 0.5  # share of the prior's deviation below which the data tell a parameter
_ENCODER = 2 * math.pi / 4096  # resolution of positions [rad]
_LEAST_LENGTH = 1.0  # of an episode that is used [s]
_SETTLE = 0.5  # beginning of an episode that is not compared, since its past is unknown [s]
_BLOCK, _BLOCKS = 2.0, 40  # longest block of time [s], and how many there are at least
ROUNDS = 15  # most steps of the fit
_NEAR, _PATIENCE = 0.01, 2  # it ends after two gains below 1 %
# Steps of the derivatives in the rounds of the fit, in deviations of the prior: large at first,
# because positions are not smooth in friction and backlash.
_DIFFERENCES = (0.3, 0.3, 0.2, 0.2, 0.1, 0.1, 0.05)
# Least standard deviation of a parameter, in deviations of the prior: what fits to arms whose
# servos are known miss, although the errors of the positions are small.
_LEAST = 0.06
_OUTLIER = 3.0  # residuals beyond so many deviations count less (Huber)
_LOOP = 0.012  # longest time that a recording loop needs from reading to commanding [s]


@dataclass(frozen=True)
class ArmMotion:
    """One episode of an arm.

    Attributes:
        goals: What the joints were told at every frame [rad], (T, n).
        positions: Where they were measured at every frame [rad], (T, n).
    """

    goals: F64
    positions: F64


def motions_of(dataset: Dataset, scene: Scene) -> list[ArmMotion]:
    """Return the episodes of a LeRobot dataset of a servo arm.

    Args:
        dataset: With `action` and `observation.state`, in degrees, the gripper's from 0 to 100.
        scene: A scene of the arm.

    Returns:
        A motion an episode that is longer than a second. A joint that wraps at half a turn turns
        on.

    Raises:
        MismatchError: If the columns are not the arm's joints.
        NotFiniteError: If a value is NaN or infinite.
        UsageError: If the arm has no servos.
        ManipError: If no episode is long enough.
    """
    goal, measured = angles_of(dataset, scene.robot, ("action", "observation.state"))
    motions: list[ArmMotion] = []
    for start, stop in zip(dataset.episodes.start, dataset.episodes.stop, strict=True):
        positions = np.asarray(np.unwrap(measured[start:stop], axis=0), float)
        goals = goal[start:stop]
        goals = goals + 2 * np.pi * np.round((positions - goals) / (2 * np.pi))
        if len(goals) >= _LEAST_LENGTH * dataset.fps:
            motions.append(ArmMotion(goals, positions))
    if not motions:
        raise ManipError(f"{dataset.root} has no episode of {_LEAST_LENGTH:.0f} second or more")
    return motions


def angles_of(dataset: Dataset, robot: Robot, keys: Sequence[str]) -> list[F64]:
    """Return joint angles [rad] of columns of a LeRobot dataset of a servo arm, (T, n) each.

    Args:
        dataset: The dataset, in degrees, the gripper's from 0 to 100.
        robot: The arm.
        keys: Names of the columns.

    Raises:
        MismatchError: If the columns are not the arm's joints.
        NotFiniteError: If a value is NaN or infinite.
        UsageError: If the arm has no servos.
    """
    names = [*robot.joint_names]
    for key in keys:
        found = dataset.features[key].table.get("names") if key in dataset.features else None
        if found != names:
            raise MismatchError(f"{key}: names", str(dataset.root), found, robot.name, names)
    columns = dataset.columns(keys)
    for key, column in columns.items():
        if not np.isfinite(column).all():
            raise NotFiniteError(f"{dataset.root}: {key} has values that are not finite")
    return [to_angles(robot, columns[key]) for key in keys]


def _gripper_of(robot: Robot) -> tuple[float, float]:
    if robot.lerobot is None:
        raise UsageError(f"{robot.name} has no servos; expected so101 or an arm like it")
    return robot.lerobot.gripper


def to_angles(robot: Robot, units: NDArray[Any]) -> F64:
    """Return joint angles [rad] of what LeRobot records, degrees and 0 to 100, (T, n)."""
    closed, opened = _gripper_of(robot)
    angles = np.radians(units.astype(np.float64))
    angles[:, -1] = closed + units[:, -1] / 100 * (opened - closed)
    return angles


def in_units(robot: Robot, angles: F64) -> F64:
    """Return joint angles [rad] as LeRobot records them, degrees and 0 to 100, (T, n)."""
    closed, opened = _gripper_of(robot)
    units = np.degrees(angles)
    units[:, -1] = 100 * (angles[:, -1] - closed) / (opened - closed)
    return units


def parameters(deviations: F64) -> F64:
    """Return the parameters (..., 8) that are some prior deviations from the default, (..., 8)."""
    default = default_servo()
    values = default * np.exp(FACTOR * deviations)
    for place, name in enumerate(PARAMETERS):
        if name in ADDED:
            values[..., place] = default[place] + ADDED[name] * deviations[..., place]
    return np.clip(values, *np.array([*BOUNDS.values()]).T)


def _lowest() -> F64:
    """Return the deviations at which added parameters are zero, (8,)."""
    return np.array(
        [
            -value / ADDED[name] if name in ADDED else -np.inf
            for name, value in zip(PARAMETERS, default_servo(), strict=True)
        ]
    )


class Arm(Protocol):
    """A function from servos to positions, with `fps` frames per second."""

    fps: float

    def positions(self, servos: F64, motion: ArmMotion, *, quick: bool = False) -> F64:
        """Return positions (L, T, n) [rad] for servos (L, n, 8), as `ServoArm` does."""
        ...


class ServoArm(Arm):
    """An arm with servos, as a function from their parameters to its positions.

    Args:
        model: The arm, compiled, where it touches nothing.
        q: Addresses of its joints in `qpos`, (n,).
        ctrl: Their motors, (n,).
        fps: Frames per second of the motions.
    """

    def __init__(self, model: mujoco.MjModel, q: I64, ctrl: I64, fps: float):
        self.fps, self._plain = fps, model
        self._q, self._ctrl = q, ctrl
        self._dof = dofs_of(model, q)
        self._models: list[mujoco.MjModel] = []  # kept, because copies of meshes take long
        self._threads = [mujoco.MjData(model) for _ in range(2)]

    @classmethod
    def of_scene(cls, scene: Scene, fps: float) -> ServoArm:
        """Return the arm of a scene."""
        q, ctrl = np.append(scene.arm_q, scene.gripper.q), scene.arm_ctrl
        return cls(scene.model, q, np.append(ctrl, scene.gripper.ctrl), fps)

    def positions(self, servos: F64, motion: ArmMotion, *, quick: bool = False) -> F64:
        """Simulate a motion with several sets of servos.

        Args:
            servos: Parameters in the order of `PARAMETERS`, (L, n, 8).
            motion: Its goals, and where it starts at rest.
            quick: Take physics steps twice as long, which costs 1 to 3 mrad.

        Returns:
            Positions at every frame [rad], (L, T, n).
        """
        steps = math.ceil(MOST_HZ / self.fps / (1 + quick))  # of the physics, in a frame
        dt = 1 / (self.fps * steps)
        model, start = self._plain, mujoco.MjData(self._plain)
        start.qpos[self._q] = motion.positions[0]
        whole = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.empty(mujoco.mj_stateSize(model, whole))
        mujoco.mj_getState(model, start, state, whole)
        control = np.tile(start.ctrl, (len(servos), len(motion.goals) * steps, 1))
        control[:, :, self._ctrl] = self._commands(servos, motion, steps, dt)
        states, _ = rollout.rollout(
            [self._model(lane, number, dt) for number, lane in enumerate(servos)],
            self._threads,
            np.tile(state, (len(servos), 1)),
            control,
        )
        places = 1 + self._q  # the time is first
        ends = states[:, steps - 1 : -1 : steps, places]
        first = np.broadcast_to(motion.positions[0], (len(servos), 1, len(places)))
        return np.concatenate([first, ends], axis=1)

    def _model(self, servos: F64, number: int, dt: float) -> mujoco.MjModel:
        """Return one of the arm's models, with servos (n, 8) and a physics step [s]."""
        values = dict(zip(PARAMETERS, servos.T, strict=True))
        if number == len(self._models):
            self._models.append(copy.copy(self._plain))
        model = self._models[number]
        model.opt.timestep = dt
        set_joints(model, self._dof, servos)
        gain = values["stiffness"] * GAIN / FACTORY_GAIN
        set_motors(model, self._ctrl, gain, values["damping"], values["torque"])
        return model

    def _commands(self, servos: F64, motion: ArmMotion, steps: int, dt: float) -> F64:
        """Return where the springs of the servos (L, n, 8) pull, at every physics step."""
        values = dict(zip(PARAMETERS, np.moveaxis(servos, -1, 0), strict=True))
        play, most = np.radians(values["play"]) / 2, values["speed"] * dt
        late = values["delay"] / dt
        joints = np.arange(servos.shape[1])
        goals, frames = motion.goals, len(motion.goals)
        ramp = at = np.broadcast_to(motion.positions[0], servos.shape[:2])
        commands = np.empty((len(servos), frames * steps, servos.shape[1]))
        for step in range(frames * steps):
            # between two physics steps, so that the result is smooth in the delay
            moment = np.maximum(step - late, 0.0)
            before = moment.astype(int)
            share = moment - before
            here = goals[before // steps, joints]
            there = goals[np.minimum((before + 1) // steps, frames - 1), joints]
            goal = here + share * (there - here)
            ramp, at = follow(ramp, at, goal, most, play)
            commands[:, step] = at
        return commands


@dataclass(frozen=True)
class Identified:
    """Servos as a dataset shows them.

    Attributes:
        joints: Names of the joints.
        values: Parameters in the order of `PARAMETERS`, (n, 8).
        low: Lower ends of the 95 % intervals, (n, 8).
        high: Upper ends.
        told: Whether the dataset tells a parameter, (n, 8). If it does not, its value and its
            interval mostly follow from the prior.
        error: Mean error of the simulated positions [rad], (n,).
        unexplained: Share of the motion's variance that is not explained, (n,).
        measured: Positions of all motions, one after the other, (T, n) [rad].
        simulated: The same with these servos.
    """

    joints: tuple[str, ...]
    values: F64
    low: F64
    high: F64
    told: NDArray[np.bool_]
    error: F64
    unexplained: F64
    measured: F64
    simulated: F64


def identify(
    arm: Arm,
    motions: Sequence[ArmMotion],
    joints: Sequence[str],
    on_round: Callable[[], None] = lambda: None,
) -> Identified:
    """Find the servos with which a simulated arm moves as a recorded one.

    Args:
        arm: The arm.
        motions: What it did.
        joints: Names of the joints.
        on_round: Called after every step of the fit.

    Returns:
        The parameters with their intervals.
    """
    z = np.zeros((len(joints), len(PARAMETERS)))
    best = _trial(arm, motions, z, _DIFFERENCES[0])
    damp, idle = np.full(len(joints), 1e-2), 0
    for number in range(ROUNDS):
        noise = _spread(best.errors)
        before = best.cost(noise)
        curve, score = best.equations(noise)
        curve = curve + damp[:, None, None] * curve * np.eye(len(PARAMETERS))
        step = np.linalg.solve(curve, score[..., None])[..., 0]
        difference = _DIFFERENCES[min(number, len(_DIFFERENCES) - 1)]
        z = np.maximum(best.z + np.clip(step, -1, 1), _lowest())
        trial = _trial(arm, motions, z, difference)
        after = trial.cost(noise)
        better = after < before
        best = best.with_joints(trial, better)
        damp = np.clip(np.where(better, damp / 4, damp * 4), 1e-6, 1e3)
        on_round()
        gained = 1 - (np.minimum(after, before) / before).min()
        idle = idle + 1 if gained < _NEAR else 0
        if idle == _PATIENCE:
            break
    return _summary(best, motions, arm.fps, joints)


@dataclass(frozen=True)
class _Trial:
    """Servos tried on the motions, z being their deviations from the default, (n, 8).

    `errors` are those of the positions after `_SETTLE`, (N, n) [rad], `slopes` the derivatives of
    the positions by z, (N, n, 8).
    """

    z: F64
    errors: F64
    slopes: F64
    simulated: F64  # positions at every frame of all motions

    def cost(self, noise: F64) -> F64:
        """Return the negative logarithm of the posterior of every joint, (n,)."""
        size = np.abs(self.errors) / noise
        huber = np.where(size < _OUTLIER, size**2 / 2, _OUTLIER * (size - _OUTLIER / 2))
        return huber.sum(0) + 0.5 * (self.z**2).sum(1)

    def weights(self, noise: F64) -> F64:
        """Return Huber's weights over the variance, (N, n)."""
        size = np.abs(self.errors) / noise
        return np.minimum(1, _OUTLIER / np.maximum(size, 1e-9)) / noise**2

    def equations(self, noise: F64) -> tuple[F64, F64]:
        """Return curvature (n, 8, 8) and descent direction (n, 8) of the cost."""
        weights = self.weights(noise)
        curve = np.einsum("ta,taj,tak->ajk", weights, self.slopes, self.slopes)
        score = np.einsum("ta,ta,taj->aj", weights, self.errors, self.slopes)
        return curve + np.eye(len(PARAMETERS)), score - self.z

    def with_joints(self, other: _Trial, which: NDArray[np.bool_]) -> _Trial:
        """Return this trial with some joints (n,) of another."""
        return _Trial(
            np.where(which[:, None], other.z, self.z),
            np.where(which, other.errors, self.errors),
            np.where(which[:, None], other.slopes, self.slopes),
            np.where(which, other.simulated, self.simulated),
        )


def _trial(arm: Arm, motions: Sequence[ArmMotion], z: F64, difference: float) -> _Trial:
    """Simulate the motions with servos and with each of their parameters changed both ways."""
    skip, count = round(_SETTLE * arm.fps), len(PARAMETERS)
    changes = difference * np.eye(count)[:, None]
    lanes = parameters(np.concatenate([z + changes, z - changes]))
    errors: list[F64] = []
    slopes: list[F64] = []
    simulated: list[F64] = []
    for motion in motions:
        [place] = arm.positions(parameters(z[None]), motion)
        simulated.append(place)
        errors.append((motion.positions - place)[skip:])
        more, less = np.split(arm.positions(lanes, motion, quick=True), 2)
        slopes.append(np.moveaxis(more - less, 0, -1)[skip:] / (2 * difference))
    return _Trial(z, *(np.concatenate(parts) for parts in (errors, slopes, simulated)))


def _spread(errors: F64) -> F64:
    """Return robust standard deviations of errors (N, n) [rad], (n,); at least an encoder's."""
    return np.maximum(1.4826 * np.median(np.abs(errors), axis=0), _ENCODER)


def _summary(
    best: _Trial, motions: Sequence[ArmMotion], fps: float, joints: Sequence[str]
) -> Identified:
    noise = _spread(best.errors)
    curve, _ = best.equations(noise)
    scores = best.weights(noise)[..., None] * best.errors[..., None] * best.slopes
    block = max(1, min(round(_BLOCK * fps), len(scores) // _BLOCKS))
    edges = np.arange(0, len(scores), block)
    blocks = np.add.reduceat(scores, edges)  # (B, n, 8)
    free = max(1, len(edges) - len(PARAMETERS))
    spread = np.einsum("baj,bak->ajk", blocks, blocks) * len(edges) / free + np.eye(len(PARAMETERS))
    inverse = np.linalg.inv(curve)
    variance = np.einsum("ajk,akl,alj->aj", inverse, spread, inverse)
    deviation = np.sqrt(variance + _LEAST**2)
    told = deviation < TOLD
    half = float(stats.t.ppf(0.975, free)) * deviation
    low, high = parameters(best.z - half), parameters(best.z + half)
    delay = PARAMETERS.index("delay")
    low[:, delay] = np.maximum(low[:, delay] - _LOOP, 0)
    measured = np.concatenate([motion.positions for motion in motions])
    return Identified(
        tuple(joints),
        parameters(best.z),
        low,
        high,
        told,
        np.abs(best.errors).mean(0),
        best.errors.var(0) / np.maximum(measured.var(0), 1e-9),
        measured,
        best.simulated,
    )
