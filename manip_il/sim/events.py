"""Events of an episode: knocks, noise on actions, and one perturbation at a given step.

Functions that change the world do so in place, and draw from the generator that they are given.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.seeding import rng_for
from manip_il.sim.conditions import Condition, merged
from manip_il.sim.scene import TABLE
from manip_il.sim.task import Task
from manip_il.sim.world import World

Change = Callable[[World, np.random.Generator], object]
WrongAction = Callable[[F64, World, np.random.Generator], F64]

_JOLT = 0.2  # largest displacement of every arm joint [rad]
_SHIFT, _DROP = (0.0, 0.1), 0.1  # sideways shift and height of a dropped object [m]
_NOTICEABLE = 1e-3  # a perturbation that moves nothing by this much is undone [rad or m]
_MAX_DRAWS = 100
_OVERLAP = -0.004  # contact distance below which a moved object overlaps something [m]


class Kind(NamedTuple):
    """One entry of `KINDS`: a change of the world (`change`), or of one action (`wrong`)."""

    words: str
    change: Change | None = None
    wrong: WrongAction | None = None
    needs_object: bool = False


def random_action(action: F64, world: World, rng: np.random.Generator) -> F64:
    """Draw an action within each joint's longest step from the measured position, (n,).

    The gripper's opening may be any.

    Args:
        action: Not used.
        world: The world.
        rng: Generator to draw from.
    """
    return world.scene.actions.random_near(world.measured, rng)


def opposite_action(action: F64, world: World, rng: np.random.Generator) -> F64:
    """Return an action with each joint's step reversed, and the gripper at its other end, (n,).

    Args:
        action: The action to reverse, (n,).
        world: The world, whose measured position the steps start from.
        rng: Not used.
    """
    actions = world.scene.actions
    low, high = actions.low[actions.gripper], actions.high[actions.gripper]
    opposite = high if action[actions.gripper] < (low + high) / 2 else low
    return np.where(actions.relative, 2 * world.measured - action, opposite)


def move_object(
    world: World, rng: np.random.Generator, distance: tuple[float, float], height: float = 0.0
) -> None:
    """Move the first object of the episode a random distance sideways, with zero velocity.

    The new place is within reach. A place where the object overlaps something is drawn again;
    nothing moves if there is no object or no free place.

    Args:
        world: The world, changed in place.
        rng: Generator to draw from.
        distance: Least and greatest distance [m].
        height: How far up the object is moved [m]; above 0 it is also turned at random, and falls.
    """
    if not world.scene.task.objects:
        return
    name = world.scene.task.objects_in(world)[0]
    one = world.scene.objects[name]
    before, start = world.physics(), world.data.qpos[one.q : one.q + 7].copy()
    half, table = min(world.extents(name)) / 2, world.scene.model.geom(TABLE)
    for _ in range(_MAX_DRAWS):
        angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(*distance)
        pose = start.copy()
        pose[:2] += length * np.array([np.cos(angle), np.sin(angle)])
        if height > 0 or name not in world.scene.hulls:  # a mesh may lie lower than that
            pose[2] = max(pose[2] + height, half)
        if height > 0:
            turn = rng.normal(size=4)
            pose[3:] = turn / np.linalg.norm(turn)
        over_table = (np.abs(pose[:2] - table.pos[:2]) < table.size[:2] - 0.05).all()
        if not over_table or not world.reach.has([*pose[:2], half]):
            continue
        world.place(name, pose[:3], pose[3:])
        _settle(world)
        contact = world.data.contact
        own = (world.model.geom_bodyid[contact.geom] == one.body).any(axis=1)
        if (contact.dist[own] > _OVERLAP).all():
            return
    world.restore(before, world.variation)


def draw_posture(world: World, rng: np.random.Generator, largest: float) -> None:
    """Turn every arm joint and its command at random. An object in the hand stays behind.

    The arm then touches nothing that it did not touch before, and the hand is where it can point
    down. The arm stays where it is if no such posture is found.

    Args:
        world: The world, changed in place.
        rng: Generator to draw from.
        largest: Largest turn of a joint [rad].
    """
    scene, data = world.scene, world.data
    low, high = (scene.actions.split(end)[0] for end in (scene.actions.low, scene.actions.high))
    before = data.qpos[scene.arm_q].copy()

    def contacts_at(q: F64) -> set[tuple[int, int, bool]]:
        data.qpos[scene.arm_q] = data.ctrl[scene.arm_ctrl] = q
        world.hold()
        world.update()
        mujoco.mj_collision(world.model, data)
        return arm_contacts(world)

    touching = contacts_at(before)
    for _ in range(_MAX_DRAWS):
        q = np.clip(before + rng.uniform(-largest, largest, len(before)), low, high)
        if contacts_at(q) <= touching and world.reach.has(world.ee.position):
            return
    contacts_at(before)


def arm_contacts(world: World) -> set[tuple[int, int, bool]]:
    """Return the contacts of the robot with anything, by their geoms.

    Returns:
        (geom, geom, False) for each contact and, if the geoms overlap, (geom, geom, True), too.
    """
    model, contact = world.scene.model, world.data.contact
    robot = model.body_rootid[model.site_bodyid[world.scene.ee_site]]
    of_robot = (model.body_rootid[model.geom_bodyid[contact.geom]] == robot).any(axis=1)
    touching = np.column_stack([contact.geom, contact.dist < _OVERLAP])[of_robot].tolist()
    return {(a, b, deep) for a, b, overlaps in touching for deep in (False, bool(overlaps))}


def _open_gripper(world: World, rng: np.random.Generator) -> None:
    world.gripper.put(world.data, world.gripper.most)
    world.hold()
    _settle(world)


KINDS: dict[str, Kind] = {
    "jolt": Kind(
        "joints off by up to 0.2 rad", change=lambda world, rng: draw_posture(world, rng, _JOLT)
    ),
    "dropped": Kind(
        "object dropped from 10 cm",
        change=lambda world, rng: move_object(world, rng, _SHIFT, _DROP),
        needs_object=True,
    ),
    "open": Kind("gripper wrongly open", change=_open_gripper, needs_object=True),
    "random": Kind("random action", wrong=random_action),
    "opposite": Kind("opposite action", wrong=opposite_action),
}


def kinds_for(task: Task) -> dict[str, Kind]:
    """Return the entries of `KINDS` that apply to a task."""
    return {name: kind for name, kind in KINDS.items() if task.objects or not kind.needs_object}


class Perturbation(Condition):
    """A condition under which one of `KINDS` happens once in an episode.

    Attributes:
        moments: The control step at which it happens, by seed.
    """

    moments: Mapping[int, int]

    def __init__(self, kind: str, moments: Mapping[int, int]):
        super().__init__(kind)
        vars(self).update(moments=moments)

    def draw(self, seed: int) -> dict[str, Any]:
        """Return the kind's name -> the control step at which it happens.

        Args:
            seed: Seed of the episode.
        """
        return {self.name: self.moments[seed]}


def standard_in(varied: Sequence[Condition]) -> Condition:
    """Return `STANDARD` with the ranges of other conditions added."""
    return Condition(STANDARD.name, **merged([*varied, STANDARD]).ranges)


STANDARD = Condition("standard", action_noise=(0.1, 0.1), knock=(0.05, 0.08), knock_step=(5, 24))


class Events:
    """Events of one episode."""

    def __init__(self, world: World, drawn: Mapping[str, Any], seed: int):
        """Take the events that were drawn for an episode.

        Args:
            world: The world that they change.
            drawn: Which events happen, how strong and when, as `Condition.draw` returns it.
            seed: Seed of the episode; directions and noise are drawn from it.
        """
        self._world = world
        self._drawn = drawn
        self._seed = seed
        self._kinds = {moment: name for name, moment in drawn.items() if name in KINDS}

    def before(self, step: int) -> bool:
        """Apply the events of a step to the world; return whether a perturbation changed it.

        A perturbation that finds no free place, or that changes nothing (fingers already open),
        leaves the world as it was, bit for bit.
        """
        world, drawn = self._world, self._drawn
        if step == drawn.get("knock_step"):
            move_object(world, rng_for(self._seed, "knock"), (drawn["knock"], drawn["knock"]))
        name = self._kinds.get(step)
        if name is None or (change := KINDS[name].change) is None:
            return False
        before, qpos = world.physics(), world.data.qpos.copy()
        change(world, rng_for(self._seed, f"perturbation {name}"))
        if np.abs(world.data.qpos - qpos).max() >= _NOTICEABLE:
            return True
        world.restore(before, world.variation)
        return False

    def action(self, action: F64, step: int) -> F64:
        """Return the action that is executed at a step, (n,).

        Args:
            action: The action of the policy, (n,); an event may add noise to it, or replace it.
            step: The control step.
        """
        name = self._kinds.get(step)
        if name is not None and (wrong := KINDS[name].wrong) is not None:
            return wrong(action, self._world, rng_for(self._seed, f"perturbation {name}"))
        if share := self._drawn.get("random_actions"):
            rng = rng_for(self._seed, "random actions", step)
            if rng.uniform() < share:
                return random_action(action, self._world, rng)
        if share := self._drawn.get("action_noise"):
            # As in Meta-World's tests of its experts, the noise is a share of each entry's range:
            # twice the longest step for a joint, the whole range of openings for the gripper.
            actions = self._world.scene.actions
            noise = rng_for(self._seed, "action noise", step).normal(0.0, share, len(action))
            return action + noise * np.where(actions.relative, 2, 1) * actions.scale
        return action


def _settle(world: World) -> None:
    """Compute everything that depends on positions, contacts included."""
    world.update()
    mujoco.mj_forward(world.model, world.data)
