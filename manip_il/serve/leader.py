"""Who moves the leader arm: the expert, a policy, a person with the sliders of a window, or nobody."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np

from manip_il.collect.drivers import policy_actions
from manip_il.collect.environments import env_spec
from manip_il.collect.rollout import Turn
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.policy import LearnedPolicy
from manip_il.mdp import F64
from manip_il.serve.cameras import Cameras
from manip_il.serve.station import Mover, Station
from manip_il.sim.window import Window
from manip_il.tasks.config import EnvConfig

_UNPACED = 1e6  # a window's frame rate, so high that it never waits: the station keeps real time [Hz]


def mover_of(leader: str, policy: LearnedPolicy | None, station: Station, cameras: Cameras | None) -> Mover:
    """Return what moves the leader: `expert`, `none`, `sliders`, or the policy, if there is one.

    cameras: those that the policy sees. Raises `RenderError` for sliders without a display.
    """
    if policy is not None:
        return _once_per_step(station, _policy_mover(policy, station, cameras))
    if leader == "sliders":
        return _once_per_step(station, _slider_mover(station))
    return station.expert if leader == "expert" else lambda: None


def load_policy(path: Path, env: EnvConfig, cameras: Cameras | None, task: str, *, trust: bool) -> LearnedPolicy:
    """Load a checkpoint; `MismatchError` unless it fits the environment and the served cameras."""
    checkpoint = Checkpoint.open(path)
    checkpoint.check_fits(env_spec(env, cameras.config if cameras is not None else None))
    return LearnedPolicy.load(checkpoint, task=task, trust=trust)


def _once_per_step(station: Station, move: Mover) -> Mover:
    """Return a mover that decides once per control step; a station asks several times."""
    last: tuple[int, int] | None = None
    joints: F64 | None = None

    def decide() -> F64 | None:
        nonlocal last, joints
        if last != (now := (station.seed, station.env.get_state().step)):
            last, joints = now, move()
        return joints

    return decide


def _policy_mover(policy: LearnedPolicy, station: Station, cameras: Cameras | None) -> Mover:
    seed = None

    def move() -> F64:
        nonlocal seed
        state, seen = station.env.get_state(), station.env.observe()
        seen.images.update(cameras.images if cameras is not None else {})
        turn = Turn(station.seed, state.step if seed == station.seed else 0, seen, state)
        seed = station.seed
        return station.to_joints(policy_actions(policy, [turn])[0])

    return move


def _slider_mover(station: Station) -> Mover:
    """Open a window whose control sliders are the leader's joints."""
    env, window = station.env, Window(station.env.scene, _UNPACED, sliders=True)
    order, seed = np.array([*env.scene.arm_ctrl, *env.scene.gripper.ctrl]), None

    def move() -> F64:
        nonlocal seed
        joints = window.commands[order] if seed == station.seed else env.data.qpos[station.follower.q]
        seed, shown = station.seed, copy.copy(env.data)
        shown.ctrl[order] = joints
        window.show(shown, env.world.variation)
        return joints

    return move
