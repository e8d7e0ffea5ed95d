"""New scenes from visited states: randomise goals, untouched objects and appearance, then label and render.

The expert is a function of the state, so it can label scenes that were never visited.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.collect.environments import make_env, make_expert
from manip_il.collect.query import branch
from manip_il.mdp import F64, Actor, Label, State, Transition
from manip_il.seeding import rng_for, stream_seeds
from manip_il.sim.conditions import Condition, draw
from manip_il.sim.config import CameraConfig
from manip_il.sim.env import ManipEnv
from manip_il.sim.variation import with_drawn
from manip_il.sim.world import World
from manip_il.tasks.config import EnvConfig
from manip_il.tasks.stock.aloha.environment import AlohaEnv

CHUNK = 25  # scenes that one worker draws at a time
# shares: new goals, moved objects, moved objects placed near the hand
GOALS = 0.8
OBJECTS = 0.7
NEAR = 0.5
_UNTOUCHED = 0.04  # least distance of an untouched object's centre from the hand [m]
_AROUND = 0.04  # standard deviation of an object's place near the hand, in x and y [m]
_DEEP = 1e-3  # largest overlap of a moved object with another [m]
_TRIES = 5  # scenes drawn for a state before the visited scene itself is used


@dataclass(frozen=True)
class Scenes:
    """How scenes are drawn from a dataset's states. cameras: None for scenes without pictures.

    anew: whether to also randomise goals and objects, not only appearance. conditions: ranges of the appearance and
    of the observations' noise. branch_steps: control steps that the expert drives from every state, for policies that
    predict chunks. first: number of the first scene in the random stream, so that datasets redrawn with the same seed
    can differ.
    """

    cameras: CameraConfig | None
    frames: int
    seed: int = 0
    anew: bool = True
    conditions: tuple[Condition, ...] = ()
    branch_steps: int = 1
    first: int = 0

    @property
    def numbers(self) -> range:
        """Numbers of the scenes in the random stream. Raises `UsageError` if the stream has too few."""
        return stream_seeds("redraw", self.first + self.frames, self.seed)[self.first :]

    def chunks(self, states: F64, leads: F64) -> Iterator[tuple[int, F64, F64]]:
        """Yield, for every `CHUNK` scenes, the number of the first scene, the visited states and their label offsets.

        states: rows of `sim_state` (S, m), used in an order drawn from the seed, repeatedly if scenes outnumber them.
        leads: offset added to the label of each state's scene, (S, n).
        """
        order = rng_for(self.seed, "order of redrawn states").permutation(len(states))
        for at in range(0, self.frames, CHUNK):
            rows = np.arange(at, min(at + CHUNK, self.frames)) % len(states)
            yield self.numbers[at], states[order[rows]], leads[order[rows]]


class SceneDrawer:
    """Draws, labels and renders scenes of one environment."""

    def __init__(self, config: EnvConfig, scenes: Scenes):
        noise = [one.only("sensing") for one in scenes.conditions]
        self._env = make_env(config, scenes.cameras, noise)
        self._has_noise = any(one.ranges for one in noise)
        self._expert = make_expert(config)
        self._scenes = scenes

    def frames(self, visited: State, number: int, seed: int, lead: F64 | float = 0.0) -> list[Transition]:
        """Return the frames of a new scene: one labelled frame, or the frames of a branch; [] without a valid label.

        visited: the state that is changed into the scene. number: scene number in the random stream. seed: value of the
        `seed` column. lead: offset added to the label of a single frame, (n,).
        """
        rng = rng_for(number, "redraw")
        if self._has_noise:
            self._env.start(number)  # draws the noise of the scene's observations
        visited = self._with_look(replace(visited, streak=0, ever=False), number)
        for _ in range(_TRIES if self._scenes.anew else 0):
            state = self.redrawn(visited, rng)
            label = self._expert.label(state) if state is not None else None
            if state is not None and label is not None and label.valid:
                break
        else:
            state, label = visited, self._expert.label(visited)
        if not label.valid:
            return []
        if self._scenes.branch_steps == 1:
            return [self._frame(state, replace(label, action=label.action + lead), seed)]
        return list(branch(self._env, self._expert, state, seed, self._scenes.branch_steps))

    def _with_look(self, state: State, number: int) -> State:
        """Return the state with a randomised appearance, if the environment supports it."""
        if not isinstance(self._env, ManipEnv):  # its appearance is fixed
            return state
        looks = [one.only("look") for one in self._scenes.conditions]
        return replace(state, variation=with_drawn(state.variation, draw(looks, number)))

    def _frame(self, state: State, label: Label, seed: int) -> Transition:
        env, action = self._env, label.action
        env.set_state(state)
        return Transition(
            seed, state.step, state, env.observe(), label, action, Actor.EXPERT, 0.0, False, True, env.progress
        )

    def redrawn(self, visited: State, rng: np.random.Generator) -> State | None:
        """Return a scene with new goals and new places of untouched objects; None if the drawn places overlap."""
        if isinstance(self._env, AlohaEnv):
            return self._env.redrawn(visited, rng)
        assert isinstance(self._env, ManipEnv)  # the only other class that has cameras
        world, task = self._env.world, self._env.scene.task
        world.restore(visited.physics, visited.variation)
        free, markers = self._untouched(world), _markers(world.model)
        poses = task.draw(rng, world).poses
        new_goals, moved = rng.uniform() < GOALS, list[int]()
        for name, (at, turn) in poses.items():
            body = world.scene.model.body(name).id
            if name in task.argument_bodies:
                continue
            if body in markers:
                if new_goals:
                    world.place(name, at, turn)
            elif body in free and rng.uniform() < OBJECTS:
                near = name in world.scene.objects and rng.uniform() < NEAR
                world.place(name, _near_hand(world, at, rng) if near else at, turn)
                moved.append(body)
        world.update()
        roots, depths = _contacts(world)
        overlaps = np.isin(roots, moved).any(axis=1) & (roots[:, 0] != roots[:, 1]) & (depths > _DEEP)
        return None if overlaps.any() else replace(visited, physics=world.physics())

    def _untouched(self, world: World) -> set[int]:
        """Return bodies of objects and furniture that are at rest and touch only what is fixed to the world."""
        model, (roots, _) = world.model, _contacts(world)
        touched = set(roots[(roots > 0).all(axis=1) & (roots[:, 0] != roots[:, 1])].ravel().tolist())
        ee = world.ee.position.tolist()
        free = {
            one.body
            for name, one in world.scene.objects.items()
            if world.at_rest(name) and math.dist(world.pose(name).position.tolist(), ee) > _UNTOUCHED
        }
        return (free | {body for body in range(model.nbody) if model.body_mocapid[body] >= 0}) - touched


@lru_cache(1)
def _markers(model: mujoco.MjModel) -> set[int]:
    """Return the bodies that mark goals: mocap bodies without collisions."""
    solid = set(model.body_rootid[model.geom_bodyid[model.geom_contype > 0]].tolist())
    return {body for body in range(model.nbody) if model.body_mocapid[body] >= 0 and body not in solid}


def _near_hand(world: World, at: F64, rng: np.random.Generator) -> F64:
    """Return a random place around the hand, at the height of `at`, (3,) [m]."""
    return np.append(world.ee.position[:2] + rng.normal(0.0, _AROUND, 2), at[2])


def _contacts(world: World) -> tuple[NDArray[np.int32], F64]:
    """Return the root bodies of every contact, (C, 2), and its depth [m], (C,)."""
    model, contacts = world.model, world.data.contact
    mujoco.mj_collision(model, world.data)
    return model.body_rootid[model.geom_bodyid[contacts.geom]], -contacts.dist
