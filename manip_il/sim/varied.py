"""An environment whose episodes differ in more than their start: heavier cubes, noisy and late sight, other views."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import Observation
from manip_il.seeding import rng_for
from manip_il.sim.conditions import NOMINAL, Circumstances, Condition, draw
from manip_il.sim.env import ManipEnv
from manip_il.sim.observe import environment_state, joint_state
from manip_il.sim.variation import with_drawn
from manip_il.sim.world import World

F64 = NDArray[np.float64]


class VariedEnv(ManipEnv):
    """`ManipEnv` under conditions; what an episode meets is drawn from its seed (`circumstances`).

    Knocks and noise on actions are a `Disturber`'s affair. The expert reads the true state, whatever a policy sees.
    """

    def __init__(self, conditions: Sequence[Condition], **settings: Any):
        super().__init__(**settings)
        self._conditions = tuple(conditions)
        self.circumstances = Circumstances(NOMINAL.name, {})
        self._told = World(self.scene)  # the world as a noisy sensor has it
        self._past: deque[Observation] = deque(maxlen=1)
        self._noise = rng_for(0, "observation noise")

    def start(self, seed: int) -> None:
        """Draw circumstances and a start."""
        self.circumstances = draw(self._conditions, seed)
        self.appearance = self.circumstances.appearance
        self._past = deque(maxlen=int(self.circumstances.number("delay")) + 1)
        self._noise = rng_for(seed, "observation noise")
        super().start(seed)

    def _drawn_variation(self) -> F64:
        return with_drawn(self.scene.nominal, self.circumstances.drawn)

    def observe(self) -> Observation:
        """What a policy sees now: late and noisy, where the episode has it so. To be asked once a control step."""
        self._past.append(self._noisy(super().observe()))
        return self._past[0]

    def _noisy(self, seen: Observation) -> Observation:
        joints, position = self.circumstances.number("joint_noise"), self.circumstances.number("position_noise")
        if not joints and not position:
            return seen
        scene, told = self.scene, self._told
        told.restore(self.world.physics(), self.world.variation)
        told.data.qpos[scene.arm_q] += self._noise.normal(0.0, joints, len(scene.arm_q))
        for one in scene.objects.values():
            told.data.qpos[one.q : one.q + 3] += self._noise.normal(0.0, position, 3)
        told.moved()  # everything follows from what was measured: the hand's pose from the joints, distances from both
        return Observation(joint_state(told), environment_state(told), seen.images)
