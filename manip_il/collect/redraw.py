"""New scenes of visited states: goals and untouched objects drawn anew, looks too, then labelled and pictured.

The expert is a function of the state, so it labels scenes that nobody drove to: as many as there are frames.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.collect.environments import make_expert
from manip_il.collect.query import branch
from manip_il.collect.rollout import Labeller
from manip_il.data import schema
from manip_il.data.atomic import write_file, writing
from manip_il.data.dataset import Dataset
from manip_il.data.episodes import to_episode
from manip_il.errors import ManipError, UsageError
from manip_il.mdp import Actor, Episode, Label, Observation, State, Transition
from manip_il.seeding import BLOCK, rng_for, stream_base
from manip_il.sim.conditions import PICTURED, Condition, draw
from manip_il.sim.config import CameraConfig, EnvConfig
from manip_il.sim.env import ManipEnv, environment_state, joint_state
from manip_il.sim.variation import completed, with_drawn
from manip_il.sim.world import World
from manip_il.tasks.points import point_names
from manip_il.tasks.table import get_task
from manip_il.tasks.task import TakesReward

F64 = NDArray[np.float64]
CHUNK = 25  # frames of one journal
STATES = "states.npy"  # visited states in the order in which frames take them, (S, m)
GOALS, OBJECTS, NEAR = 0.8, 0.7, 0.5  # shares: of new goals, of moved objects, and of those that come near the hand
_UNTOUCHED = 0.04  # of an object's centre from the hand [m]
_AROUND = 0.04  # standard deviation of an object's place near the hand, in x and y [m]
_DEEP = 1e-3  # what is moved may overlap with something by so much [m]
_TRIES = 5  # scenes drawn for a state, before it stays as it was visited


@dataclass(frozen=True)
class RedrawJob:
    """Frames of redrawn states, `CHUNK` for a seed. files: a folder with `STATES`.

    scenes: draw goals and objects anew, too, and not looks alone. conditions: what the looks of every frame are drawn
    from. branch_steps: control steps for which the expert drives on from every state, for policies that plan. first:
    number of the first frame in the stream of draws, so that several jobs of one seed draw different scenes.
    """

    env: EnvConfig
    cameras: CameraConfig
    files: Path
    frames: int
    seed: int = 0
    scenes: bool = True
    conditions: tuple[Condition, ...] = ()
    branch_steps: int = 1
    first: int = 0

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise UsageError(f"frames is {self.frames}; expected at least 1")
        if self.branch_steps < 1:
            raise UsageError(f"branch_steps is {self.branch_steps}; expected at least 1")

    learned, batch = False, 1

    def with_files(self, files: Path) -> RedrawJob:
        """Return the same where its folder has been copied to."""
        return replace(self, files=files)

    @property
    def seeds(self) -> range:
        """Seeds of the journals; each is the number of its first frame in the stream."""
        return range(self._base, self._base + self.frames, CHUNK)

    @property
    def _base(self) -> int:
        if self.first + self.frames > BLOCK:
            raise UsageError(f"frames {self.first} to {self.first + self.frames}; a seed has {BLOCK:,}, take another")
        return stream_base("redraw", self.seed) + self.first

    def run(self, seeds: Sequence[int]) -> Iterator[Episode]:
        """Yield an episode a seed: every frame, or branch, is a part that ends."""
        base, states = self._base, _read_states(self.files)
        redrawer = _redrawer(self.env, self.cameras)
        for seed in seeds:
            frames: list[Transition] = []
            for number in range(seed, min(seed + CHUNK, base + self.frames)):
                visited = State.from_vector(states[(number - base) % len(states)])
                frames += redrawer.frames(visited, seed, number, self)
            yield to_episode(frames)


def write_states(source: Path, folder: Path, seed: int) -> int:
    """Write the states of a dataset, in an order drawn by the seed, to a job's folder; return how many there are.

    Raises `ManipError` for a dataset without `sim_state`, and where they cannot be written.
    """
    states = Dataset.open(source).columns([schema.SIM_STATE])[schema.SIM_STATE]
    order = rng_for(seed, "order of redrawn states").permutation(len(states))
    content = io.BytesIO()
    np.save(content, states[order], allow_pickle=False)
    with writing(folder / STATES):
        folder.mkdir(parents=True, exist_ok=True)
    write_file(folder / STATES, content.getvalue())
    return len(states)


@lru_cache(1)
def _read_states(folder: Path) -> F64:
    try:
        states = np.load(folder / STATES, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise ManipError(f"cannot read {folder / STATES}: {error}") from error
    if states.ndim != 2 or states.dtype != np.float64 or not len(states):
        raise ManipError(f"{folder / STATES} holds {states.dtype} of shape {states.shape}; expected states (S, m)")
    return states


@lru_cache(2)
def _redrawer(env: EnvConfig, cameras: CameraConfig) -> _Redrawer:
    return _Redrawer(env, cameras)


class _Redrawer:
    """Redraws, labels and pictures states of one environment."""

    def __init__(self, config: EnvConfig, cameras: CameraConfig):
        self._env = ManipEnv.of(config, cameras)
        self._task = get_task(config.task, config.object, config.reward)
        self._expert: Labeller = make_expert(config)
        self._config = config
        self._branch_env = ManipEnv.of(config, cameras)

    def frames(self, visited: State, seed: int, number: int, job: RedrawJob) -> Iterator[Transition]:
        """Yield what becomes of one visited state; one frame without a sound label where nothing sound does."""
        rng = rng_for(number, "redraw")
        visited = self._with_look(replace(visited, streak=0, ever=False), job, number)
        for _ in range(_TRIES if job.scenes else 0):
            state = self._redrawn(visited, rng)
            label = self._expert.label(state) if state is not None else None
            if state is not None and label is not None and label.valid:
                break
        else:
            state, label = visited, self._expert.label(visited)
        if not label.valid or job.branch_steps == 1:
            yield self._frame(state, label, seed)
        else:
            yield from branch(self._branch_env, self._expert, state, seed, job.branch_steps)

    def _with_look(self, state: State, job: RedrawJob, number: int) -> State:
        """The state with the looks of a frame; as it was where nothing is drawn."""
        variation = completed(state.variation, self._env.scene.nominal)
        drawn = draw(job.conditions, number, self._config.object).values if job.conditions else {}
        return replace(state, variation=with_drawn(variation, {key: drawn[key] for key in PICTURED if key in drawn}))

    def _frame(self, state: State, label: Label, seed: int) -> Transition:
        self._env.set_state(state)
        seen = self._env.observe() if label.valid else self._unseen()
        action = label.action
        return Transition(
            seed, state.step, state, seen, label, action, Actor.EXPERT, 0.0, False, True, self._env.progress
        )

    def _unseen(self) -> Observation:
        """Return the observation with black pictures: a frame without a sound label is left out of datasets."""
        world, black = self._env.world, np.zeros((*self._env.image_size, 3), np.uint8)
        images = {camera: black for camera in self._env.cameras}
        nowhere = {camera: np.zeros((len(point_names(world.scene)), 3), np.float32) for camera in self._env.cameras}
        return Observation(joint_state(world), environment_state(world), images, self._env.task_description, nowhere)

    def _redrawn(self, visited: State, rng: np.random.Generator) -> State | None:
        """A scene with other goals and other places of what is untouched; None for one that cannot be."""
        world = self._env.world
        world.restore(visited.physics, visited.variation)
        free = self._untouched(world)
        poses = self._task.draw(rng, world).poses
        kept = self._task.taste if isinstance(self._task, TakesReward) else ()
        new_goals, moved = rng.uniform() < GOALS, list[int]()
        for name, (at, turn) in poses.items():
            body = world.scene.model.body(name).id
            if name in kept:
                continue
            if body in self._markers:
                if new_goals:
                    world.place(name, at, turn)
            elif body in free and rng.uniform() < OBJECTS:
                near = name in world.scene.objects and rng.uniform() < NEAR
                world.place(name, _near_hand(world, at, rng) if near else at, turn)
                moved.append(body)
        world.update()
        if any(depth > _DEEP for depth in _overlaps(world, moved)):
            return None
        return replace(visited, physics=world.physics())

    @cached_property
    def _markers(self) -> set[int]:
        """Bodies that show goals: starts place them, and nothing touches them."""
        model = self._env.scene.model
        solid = set(model.body_rootid[model.geom_bodyid[model.geom_contype > 0]].tolist())
        return {body for body in range(model.nbody) if model.body_mocapid[body] >= 0 and body not in solid}

    def _untouched(self, world: World) -> set[int]:
        """Objects and furniture, as bodies, that touch nothing but what is fixed to the world, and rest."""
        model, data = world.model, world.data
        mujoco.mj_collision(model, data)
        roots = model.body_rootid[model.geom_bodyid[data.contact.geom]]  # (contacts, 2)
        touched = set(roots[(roots > 0).all(axis=1) & (roots[:, 0] != roots[:, 1])].ravel().tolist())
        ee = world.ee.position.tolist()
        free = {
            one.body
            for name, one in world.scene.objects.items()
            if world.at_rest(name) and math.dist(world.pose(name).position.tolist(), ee) > _UNTOUCHED
        }
        return (free | {body for body in range(model.nbody) if model.body_mocapid[body] >= 0}) - touched


def _near_hand(world: World, at: F64, rng: np.random.Generator) -> F64:
    """A place about the hand, at the height of another, (3,) [m]."""
    return np.append(world.ee.position[:2] + rng.normal(0.0, _AROUND, 2), at[2])


def _overlaps(world: World, bodies: Sequence[int]) -> Iterator[float]:
    """Yield how deep these bodies are in others [m]."""
    model, data = world.model, world.data
    mujoco.mj_collision(model, data)
    for contact in data.contact:
        roots = [int(model.body_rootid[model.geom_bodyid[geom]]) for geom in contact.geom]
        if roots[0] != roots[1] and not set(bodies).isdisjoint(roots):
            yield -float(contact.dist)
