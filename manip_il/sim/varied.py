"""An environment whose episodes differ in more than their start: heavier cubes, noisy and late sight, other views."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from manip_il.mdp import Observation
from manip_il.seeding import rng_for
from manip_il.sim.conditions import CUBE_EDGE, NOMINAL, Circumstances, Condition, changes_object, draw
from manip_il.sim.env import ManipEnv
from manip_il.sim.observe import environment_state
from manip_il.sim.scene import Scene
from manip_il.sim.world import CUBE_FRICTION, CUBE_MASS


class VariedEnv(ManipEnv):
    """`ManipEnv` under conditions; what an episode meets is drawn from its seed (`circumstances`).

    Knocks and noise on actions are a `Disturber`'s affair. The expert reads the true state, whatever a policy sees,
    and takes every cube for the model's.
    """

    def __init__(self, conditions: Sequence[Condition], **settings: Any):
        super().__init__(**settings)
        self._conditions = tuple(conditions)
        self.circumstances = Circumstances(NOMINAL.name, {})
        self._worlds = {False: (self.scene, self.data)}  # by whether the object differs from the model's
        if any(changes_object(condition.ranges) for condition in self._conditions):
            own = replace(self.scene, model=copy.copy(self.scene.model))  # physics reads mass and size from there
            self._worlds[True] = (own, mujoco.MjData(own.model))
        self._told: Any = mujoco.MjData(self.scene.model)  # the world as a noisy sensor has it
        self._past: deque[Observation] = deque(maxlen=1)
        self._noise = rng_for(0, "observation noise")

    def start(self, seed: int) -> None:
        """Draw circumstances and a start."""
        self.circumstances = draw(self._conditions, seed)
        self.appearance = self.circumstances.appearance
        self._past = deque(maxlen=int(self.circumstances.number("delay")) + 1)
        self._noise = rng_for(seed, "observation noise")
        different = changes_object(self.circumstances.drawn)
        self.scene, self.data = self._worlds[different]
        if different:
            _shape_object(self.scene, self.data, self.circumstances)
        super().start(seed)

    def observe(self) -> Observation:
        """What a policy sees now: late and noisy, where the episode has it so. To be asked once a control step."""
        self._past.append(self._noisy(super().observe()))
        return self._past[0]

    def _noisy(self, seen: Observation) -> Observation:
        joints, position = self.circumstances.number("joint_noise"), self.circumstances.number("position_noise")
        if not joints and not position:
            return seen
        scene = self.scene
        self._told.qpos[:] = self.data.qpos
        self._told.qpos[scene.arm_q] += self._noise.normal(0.0, joints, len(scene.arm_q))
        if scene.object_q is not None:
            self._told.qpos[scene.object_q : scene.object_q + 3] += self._noise.normal(0.0, position, 3)
        # Everything follows from what was measured: the hand's pose from the joints, distances from both.
        mujoco.mj_kinematics(scene.model, self._told)
        state = np.append(self._told.qpos[scene.arm_q], self._told.qpos[scene.finger_q].sum()).astype(np.float32)
        return Observation(state, environment_state(scene, self._told, self._goal), seen.images)


def _shape_object(scene: Scene, data: mujoco.MjData, circumstances: Circumstances) -> None:
    """Give the cube of a model that nobody else uses its mass [kg], edge [m] and friction."""
    model: Any = scene.model
    body, geom = model.body("object").id, model.geom("object").id
    mass, edge = circumstances.number("mass", CUBE_MASS), circumstances.number("size", CUBE_EDGE)
    model.body_mass[body] = mass
    model.body_inertia[body] = mass * edge**2 / 6
    model.geom_size[geom] = edge / 2
    model.geom_rbound[geom] = np.sqrt(3) * edge / 2
    model.geom_aabb[geom, 3:] = edge / 2
    for node in range(model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body]):
        model.bvh_aabb[node, 3:] = edge / 2
    model.geom_friction[geom, 0] = circumstances.number("friction", CUBE_FRICTION)
    # Of two geoms that touch, the larger friction counts unless one has priority: here the drawn one counts.
    model.geom_priority[geom] = 1 if "friction" in circumstances.drawn else 0
    mujoco.mj_setConst(model, data)  # what follows from masses
