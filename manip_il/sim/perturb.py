"""One perturbation an episode: the world is changed once, or one action is wrong, at a step that is given.

What a recoverability certificate is measured with: how the expert goes on from there is what it says.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UnknownName, UsageError
from manip_il.seeding import rng_for
from manip_il.sim.disturb import drop_object, jolt_joints, knock_object, set_fingers
from manip_il.sim.env import ManipEnv
from manip_il.tasks.task import Task

F64 = NDArray[np.float64]
Change = Callable[[ManipEnv, np.random.Generator], object]
WrongAction = Callable[[F64, ManipEnv, np.random.Generator], F64]

JOLT = 0.2  # of every arm joint at most [rad]
SHIFT = (0.0, 0.1)  # of the object, sideways [m]
DROP = 0.1  # of the object, upwards [m]
NOTICEABLE = 1e-3  # a world in which nothing moved by this much was not changed [rad or m]


@dataclass(frozen=True)
class Kind:
    """One entry of `KINDS`: how the world is changed (`change`), or how the action is wrong (`wrong`)."""

    words: str
    change: Change | None = None
    wrong: WrongAction | None = None
    needs_object: bool = True


def random_action(action: F64, env: ManipEnv, rng: np.random.Generator) -> F64:
    """Any action within one longest joint step of the measured joints, with any gripper opening; (n,)."""
    return env.scene.actions.random_near(_measured(env), rng)


def opposite_action(action: F64, env: ManipEnv, rng: np.random.Generator) -> F64:
    """Return the joint step of `action` (n,) mirrored about the measured joints, and the opposite gripper command."""
    mirrored = 2 * _measured(env) - action
    return np.where(env.scene.actions.relative, mirrored, _other_opening(action, env))


def wrong_gripper(action: F64, env: ManipEnv, rng: np.random.Generator) -> F64:
    """`action` (n,) with the opposite gripper command."""
    return np.where(env.scene.actions.relative, action, _other_opening(action, env))


KINDS: dict[str, Kind] = {
    "jolt": Kind(
        "joints off by up to 0.2 rad", change=lambda env, rng: jolt_joints(env, rng, JOLT), needs_object=False
    ),
    "moved": Kind("object moved up to 10 cm", change=lambda env, rng: knock_object(env, rng, SHIFT)),
    "dropped": Kind("object dropped from 10 cm", change=lambda env, rng: drop_object(env, rng, SHIFT, DROP)),
    "closed": Kind("gripper wrongly closed", change=lambda env, rng: set_fingers(env, 0.0)),
    "open": Kind("gripper wrongly open", change=lambda env, rng: set_fingers(env, env.world.most_opening)),
    "random": Kind("random action", wrong=random_action, needs_object=False),
    "opposite": Kind("opposite action", wrong=opposite_action, needs_object=False),
    "gripper": Kind("right arm, opposite gripper", wrong=wrong_gripper),
}


def kinds_for(task: Task) -> dict[str, Kind]:
    """Return the entries of `KINDS` that mean something in a task: without an object, nor does the gripper matter."""
    return {name: kind for name, kind in KINDS.items() if task.grasped or not kind.needs_object}


@dataclass(frozen=True)
class Perturbation:
    """What happens once in every episode. moments: the episode's seed -> the control step at which it does."""

    kind: str
    moments: Mapping[int, int]

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UnknownName("perturbation", self.kind, KINDS)
        if any(step < 0 for step in self.moments.values()):
            raise UsageError(f"a perturbation at step {min(self.moments.values())}; expected 0 or later")


class Perturber:
    """One episode's perturbation, drawn from its seed.

    A change that finds no place, or that is none (fingers that are open already), leaves the state as it was, bit for
    bit. After one that happens, the steps within the tolerance count from the beginning. Raises `UsageError` where the
    kind needs an object that the task has not, or no moment is given for the seed.
    """

    def __init__(self, env: ManipEnv, perturbation: Perturbation, seed: int):
        if perturbation.kind not in kinds_for(env.scene.task):
            raise UsageError(f"perturbation {perturbation.kind!r} needs an object; {env.task} has none")
        if seed not in perturbation.moments:
            raise UsageError(f"perturbation {perturbation.kind!r} has no moment for seed {seed}; give one")
        self._env, self._kind = env, KINDS[perturbation.kind]
        self._moment = perturbation.moments[seed]
        self._rng = rng_for(seed, f"perturbation {perturbation.kind}")
        self._now = False

    def before(self, step: int) -> None:
        """Change the world, where this is the step and the kind for it."""
        self._now = step == self._moment
        if not self._now or self._kind.change is None:
            return
        before, qpos = self._env.get_state(), self._env.data.qpos.copy()
        self._kind.change(self._env, self._rng)
        if np.abs(self._env.data.qpos - qpos).max() < NOTICEABLE:
            self._env.set_state(before)
        else:
            self._env.set_state(replace(self._env.get_state(), streak=0))

    def action(self, action: F64) -> F64:
        """Return the action as it reaches the robot, (n,)."""
        if not self._now or self._kind.wrong is None:
            return action
        return self._kind.wrong(action, self._env, self._rng)


def _measured(env: ManipEnv) -> F64:
    """Joint positions [rad] and opening [m], (n,)."""
    scene = env.scene
    return scene.actions.join(env.data.qpos[scene.arm_q], env.world.opening)


def _other_opening(action: F64, env: ManipEnv) -> float:
    """The end of the gripper's range that the command in `action` is farther from [m]."""
    gripper = env.scene.gripper
    return gripper.most if action[env.scene.actions.gripper] < (gripper.least + gripper.most) / 2 else gripper.least
