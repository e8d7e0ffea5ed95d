"""Who moves the leader arm: the expert, a policy, the sliders of a window, or nobody."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from manip_il.collect.drivers import policy_actions
from manip_il.collect.expert import Expert
from manip_il.collect.rollout import Turn
from manip_il.learn.policy import LearnedPolicy
from manip_il.mdp import Label
from manip_il.serve.cameras import Cameras
from manip_il.serve.station import Mover, Station
from manip_il.sim.window import Window

F64 = NDArray[np.float64]


class ExpertMover:
    """Moves the leader to where the expert's label says, and by what the follower sags beyond it, as people do."""

    def __init__(self, station: Station):
        self._expert = Expert(station.env.scene)
        self.label: Label | None = None

    def __call__(self, station: Station) -> F64 | None:
        """Return the leader's joints [rad], (n,); None in a state without a sound label."""
        self.label = self._expert.label(station.env.get_state(), station.env.world)
        if not self.label.valid:
            return None
        return station.to_joints(self.label.action) + station.follower.sag()


def policy_mover(station: Station, policy: LearnedPolicy, cameras: Cameras | None) -> Mover:
    """Return a mover that a policy is: it acts once a control step."""
    said: dict[str, tuple[int, int, F64]] = {}

    def move(station: Station) -> F64:
        env = station.env
        seed, step, joints = said.get("last", (-1, -1, station.leader.q))
        state = env.get_state()
        if (seed, step) != (station.seed, state.step):
            seen = env.observe()
            if cameras is not None:
                seen.images.update(cameras.images)
            first = 0 if seed != station.seed else state.step
            turns: Sequence[Turn] = [Turn(station.seed, first, seen, state)]
            joints = station.to_joints(policy_actions(policy, turns)[0])
            said["last"] = (station.seed, state.step, joints)
        return joints

    return move


def slider_mover(station: Station) -> Mover:
    """Return a mover that the control sliders of a window are, which shows the world. Raises `RenderError`."""
    env = station.env
    window, shown = Window(env.scene, env.config.control_hz * 100, sliders=True), [-1]
    order = [*env.scene.arm_ctrl, *env.scene.gripper.ctrl]

    def move(station: Station) -> F64:
        step = env.get_state().step
        commands = station.leader.q if shown[0] < 0 else window.commands[order]
        if step != shown[0]:
            shown[0] = step
            window.show(env.data, env.looks)
        return commands

    return move
