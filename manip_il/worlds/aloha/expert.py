"""The expert of two arms: one label for both hands, a function of the state alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from importlib import import_module

import mujoco
import numpy as np

from manip_il.caching import cached_per_thread
from manip_il.mdp import F64, Label
from manip_il.robots.geometry import turned_towards
from manip_il.robots.ik import PoseProgram
from manip_il.worlds.aloha.ladder import SIDES, AlohaScene, Hand, HandTarget, phases

ORIENTATION, POSTURE = 0.3, 0.003  # costs [1/rad], relative to 1 [1/m] for the position
# forearm roll's cost at a straight wrist; peak's width, wrist up and down [rad]
ROLL, STRAIGHT = 0.15, (0.15, 0.35)
FOREARM_ROLL, WRIST = 3, 4
MOST_STEP, MOST_TURN = 0.10, 0.5  # largest step of a hand towards its target [m], [rad]
FALLEN = -0.02  # an object lower than this has fallen off the table [m]
REACH = (0.2, 0.68)  # range of an arm on the table, from its foot [m]
CREEPS = 0.95  # share of the breakaway lead below which a joint creeps
BREAKAWAY = 1.5  # step of a joint per lead beyond it


def label(scene: AlohaScene, arms: Mapping[str, ArmExpert], bias: F64) -> Label | str:
    """Return the label of one state, or why there is no sound action.

    Args:
        scene: The state.
        arms: Side -> its arm.
        bias: Forces of gravity and motion on all joints of the model, (nv,).
    """
    if reason := _unsound(scene, arms):
        return reason
    action, names = list[float](), list[str]()
    for side, arm in arms.items():
        rung = next(rung for rung in scene.rungs[side] if rung.holds(scene))
        target = rung.target(scene)
        command = arm.command(scene.hands[side], target, bias)
        if command is None:
            return f"inverse kinematics of the {side} arm has no solution"
        action += [*command, target.gripper]
        names.append(rung.name)
    return Label(np.array(action), phases(type(scene)).index(", ".join(names)), True, 0.0)


def _unsound(scene: AlohaScene, arms: Mapping[str, ArmExpert]) -> str:
    if scene.arms_touch:
        return "the arms touch"
    for name, side in scene.grasped.items():
        position = scene.things[name].position
        if position[2] < FALLEN:
            return f"{name} off the table"
        near, far = REACH
        if not near < math.dist(position[:2], arms[side].foot) < far:
            return f"{name} out of the {side} arm's reach"
    return ""


class ArmExpert:
    """One arm: converts a target of its hand to targets of its joints, (6,) [rad].

    Args:
        model: The environment's model.
        number: 0 for the left arm, 1 for the right one.
        side: The same by name.
    """

    def __init__(self, model: mujoco.MjModel, number: int, side: str):
        self.side = side
        self._joints = joints = np.arange(8 * number, 8 * number + 6)
        self.foot = model.body(f"vx300s_{side}").pos[:2].tolist()
        constants = import_module("gym_aloha.constants")
        self._gain = model.actuator_gainprm[joints, 0]
        # lead at which a joint overcomes friction [rad]
        self._breakaway = model.dof_frictionloss[joints] / self._gain
        # Below it joints creep, because MuJoCo's friction is soft: an impedance of 0.9 within 0.02
        # s.
        softness = (
            self._gain
            * model.dof_invweight0[joints]
            * (0.1 / 0.9)
            * (CREEPS * constants.DT)
            / 2
            * constants.DT
        )
        self._creep = 1 - np.exp(-softness)  # step per lead [rad/rad]

    def command(self, hand: Hand, target: HandTarget, bias: F64) -> F64 | None:
        """Return joint targets (6,) [rad] one step towards a target.

        Args:
            hand: The arm's hand.
            target: Where it should go.
            bias: Forces of gravity and motion on all joints of the model, (nv,).

        Returns:
            The targets; None if there is no solution.
        """
        ik = _program(self.side)
        way = target.position - hand.position
        length = float(np.linalg.norm(way))
        position = hand.position + way * min(1.0, MOST_STEP / max(length, MOST_STEP))
        ik.data.qpos[:] = hand.q
        ik.update()
        ik.posture.set_cost(_posture_costs(hand.q))
        step = ik.solve(position, turned_towards(hand.rotation, target.rotation, MOST_TURN))
        if step is None:
            return None
        step *= min(1.0, target.longest / max(float(np.abs(step).max()), target.longest))
        gravity = bias[self._joints] / self._gain
        return hand.q + self._lead(step) + gravity

    def _lead(self, step: F64) -> F64:
        """Lead of joint targets over joints, (6,) [rad], that moves the joints by `step` (6,)
        despite friction.
        """
        size, most = np.abs(step), CREEPS * self._breakaway
        crept = self._creep * most
        return np.sign(step) * np.where(
            size <= crept, size / self._creep, most + (size - crept) / BREAKAWAY
        )


def _posture_costs(q: F64) -> F64:
    """Costs of the posture, (6,) [1/rad]: they keep the forearm from winding around if the wrist
    is straight.
    """
    costs = np.full(len(q), POSTURE)
    straight = math.exp(-((q[WRIST] / STRAIGHT[int(q[WRIST] <= 0)]) ** 2))
    costs[FOREARM_ROLL] = math.hypot(POSTURE, ROLL * straight)
    return costs


@cached_per_thread()
def _program(side: str) -> PoseProgram:
    """Inverse kinematics of an arm, which all environments of a thread share."""
    home = np.array(import_module("gym_aloha.constants").START_ARM_POSE[:6])
    return PoseProgram(_alone(side), f"cali_{side}_site1", home, (ORIENTATION, POSTURE))


def _alone(side: str) -> mujoco.MjModel:
    """One arm's model, with nothing else and without fingers."""
    assets = import_module("gym_aloha.constants").ASSETS_DIR
    spec = mujoco.MjSpec.from_file(str(assets / "bimanual_viperx_transfer_cube.xml"))
    other = next(one for one in SIDES if one != side)
    fingers = [f"vx300s_{side}/{finger}_finger_link" for finger in SIDES]
    bodies = [spec.body(name) for name in ("box", "table", f"vx300s_{other}", *fingers)]
    for part in [*spec.actuators, *spec.keys, *spec.cameras, *bodies]:
        spec.delete(part)
    for geom in list(spec.geoms):
        spec.delete(geom)
    return spec.compile()
