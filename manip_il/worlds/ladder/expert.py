"""The expert: a function of `State` alone, which labels any state that a learner reaches."""

import math
from typing import override

import numpy as np

from manip_il.errors import ManipError
from manip_il.mdp import F64, Label, State
from manip_il.robots.geometry import turned_towards
from manip_il.robots.ik import ArmIK
from manip_il.sim.env import ManipEnv
from manip_il.sim.task import Target
from manip_il.sim.world import Scene, World
from manip_il.worlds.contract import Environment, Expert

FALLEN = -0.05  # an object below this height has left the table [m]
NO_PROGRESS = 0.995  # a step that leaves more than this share of the error makes no progress
NEAR = 0.03  # distance of the hand from its target below which lack of progress is accepted [m]


class LadderExpert(Expert):
    """Labels any state of one scene.

    The same state gives bit-equal labels in any order and process: inverse kinematics starts from
    the measured joints with a fixed posture target, and the phase follows from the geometry,
    gripper opening and touch.
    """

    def __init__(self, scene: Scene):
        self._scene, self._world = scene, World(scene)
        self._ik = ArmIK(scene.robot)
        self._task, rungs = scene.task, scene.task.rungs
        self._rungs = tuple(zip(range(len(rungs), 0, -1), rungs, strict=True))

    @override
    def label(self, state: State, environment: Environment | ManipEnv | None = None) -> Label:
        """Return the expert's action in `state`: joint targets [rad] and gripper command [m], (n,).

        If there is no sound action (the object is out of reach, or inverse kinematics has no
        solution), `valid` is false, `reason` says why, and the action holds the arm still.

        Args:
            state: The state to label.
            environment: One of the same scene that is already in this state, with poses up to date;
                it is only read.

        Raises:
            MismatchError: for a state of another scene.
        """
        if isinstance(environment, ManipEnv) and environment.scene is self._scene:
            world = environment.world
        else:
            world = self._world
            world.restore(state.physics, state.variation)
        q = world.data.qpos[self._scene.arm_q]
        if reason := self._unsound(world):
            return self._hold(q, world, reason)
        for phase, rung in self._rungs:
            if rung.holds(world):
                target = rung.target(world)
                if not isinstance(target, Target):
                    kind = type(target).__name__
                    raise ManipError(
                        f"{self._scene.name}: rung {rung.name!r} returned a {kind}; expected a"
                        " Target"
                    )
                return self._towards(q, world, target, phase)
        raise ManipError(
            f"{self._scene.name}: no rung holds; expected the last rung to hold in every state"
        )

    def _unsound(self, world: World) -> str:
        hand = world.ee.position.tolist()
        for name in self._task.objects_in(world):
            position = world.pose(name).position.tolist()
            if position[2] < FALLEN:
                return f"{name} off the table"
            in_hand = math.dist(position, hand) < world.extents(name)[0] / 2
            reaches = world.reach.leaning if name in self._task.grasped else world.reach.nearly
            if not in_hand and not reaches(position):
                return f"{name} out of reach"
        return self._task.unsound(world)

    def _towards(self, q: F64, world: World, target: Target, phase: int) -> Label:
        ee, ee_rotation = self._ik.ee_pose(q)
        position = ee + _clip_norm(target.position - ee, target.max_step)
        rotation = turned_towards(ee_rotation, target.rotation, target.max_turn)
        step = self._step(q, position, rotation, target)
        if step is None:
            return self._hold(q, world, "inverse kinematics has no solution")
        dq, residual = step
        if residual > NO_PROGRESS and math.dist(position.tolist(), ee.tolist()) > NEAR:
            return self._hold(q, world, "no joint step brings the hand nearer")
        low, high = self._scene.actions.low, self._scene.actions.high
        action = self._scene.actions.join(q + dq + world.lead(dq), target.opening)
        return Label(np.minimum(np.maximum(action, low), high), phase, True, residual)

    def _step(
        self, q: F64, position: F64, rotation: F64, target: Target
    ) -> tuple[F64, float] | None:
        """Return a joint step [rad] and the share of the error that it leaves.

        If the target is `exact`, the step is solved again with the pose shifted by the error of the
        first solution.
        """
        ik, most = self._ik, self._scene.robot.max_joint_step
        first = ik.step(position, rotation, most, target.lean)
        if first is None or not target.exact:
            return first
        reached, turned = ik.ee_pose(q + first[0])
        ik.ee_pose(q)
        second = ik.step(2 * position - reached, rotation @ turned.T @ rotation, most, target.lean)
        return first if second is None else (second[0], first[1])

    def _hold(self, q: F64, world: World, reason: str) -> Label:
        actions = self._scene.actions
        action = actions.join(q + world.lead(0 * q), world.opening)
        return Label(
            np.minimum(np.maximum(action, actions.low), actions.high), 0, False, 1.0, reason
        )


def _clip_norm(vector: F64, longest: float) -> F64:
    norm = math.hypot(*vector.tolist())
    return vector if norm <= longest else vector * (longest / norm)
