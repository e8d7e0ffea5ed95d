"""One joint and its servo, as equations: many recordings or many servos at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from manip_il.mdp import F64
from manip_il.serve.config import FACTORY_GAIN

STEP = 0.001  # longest step of the integration [s]


def simulate(
    servo: Mapping[str, F64],
    goals: F64,
    start: F64,
    dt: float,
    *,
    gain: F64,
    inertia: F64,
    load: Callable[[int, F64], F64],
) -> F64:
    """Return the positions of joints whose servos follow goals.

    It is the model of `serve.servo.Follower` for a joint on its own: a goal that is late and that
    moves at most at `speed`, backlash, a spring that yields at `torque`, damping, dry friction.

    Args:
        servo: The parameters of `ServoConfig` by name, in its units, (L,) each or one for all.
        goals: The servos' goals at every sample, (L, T) [rad].
        start: The joints' positions at the first sample, at rest, (L,) [rad].
        dt: Time between samples [s].
        gain: P_Coefficient, (L,) or one for all.
        inertia: Moment of inertia that the joint moves, without the armature, (L,) [kg m^2].
        load: Returns the torque against the joint, (L,) [N m], at a sample and joint positions.

    Returns:
        Positions at every sample, (L, T) [rad].
    """
    times, substeps = goals.shape[1], math.ceil(dt / STEP - 1e-9)
    step = dt / substeps
    stiffness = servo["stiffness"] * gain / FACTORY_GAIN
    damping, friction = servo["damping"], servo["friction"]
    mass = inertia + servo["armature"]
    play, offset = np.radians(servo["play"]) / 2, np.radians(servo["offset"])
    wanted = goals - np.expand_dims(offset, -1)
    lanes = np.arange(len(goals))
    x, v = start.astype(np.float64), np.zeros(len(start))
    ramp, at = wanted[:, 0].copy(), x.copy()
    positions = np.empty(goals.shape)
    for sample in range(times):
        positions[:, sample] = x
        late = np.maximum(sample - servo["delay"] / dt, 0.0)
        before = np.floor(late).astype(int)
        share = late - before
        here, there = wanted[lanes, before], wanted[lanes, np.minimum(before + 1, times - 1)]
        goal = (1 - share) * here + share * there
        against = load(sample, x)
        for _ in range(substeps):
            ramp = np.clip(goal, ramp - servo["speed"] * step, ramp + servo["speed"] * step)
            at = np.clip(at, ramp - play, ramp + play)
            pull = stiffness * (at - x) - damping * v
            force = np.clip(pull, -servo["torque"], servo["torque"]) - against
            free, stop = v + step * force / mass, step * friction / mass
            v = np.where(np.abs(free) <= stop, 0.0, free - np.sign(free) * stop)
            x = x + step * v
    return positions
