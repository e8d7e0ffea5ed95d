"""New scenes from visited states: randomise goals, untouched objects and appearance, then label and render.

The expert is a function of the state, so it can label scenes that were never visited.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from manip_il.collect.query import branch
from manip_il.mdp import F64, Actor, Label, State, Transition
from manip_il.seeding import rng_for, stream_seeds
from manip_il.sim.conditions import Condition, draw
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import make_env, make_expert

CHUNK = 25  # scenes that one worker draws at a time
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
        visited = replace(visited, streak=0, ever=False)
        if drawn := draw([one.only("look") for one in self._scenes.conditions], number):
            visited = self._env.varied(visited, drawn)
        for _ in range(_TRIES if self._scenes.anew else 0):
            state = self._env.redrawn(visited, rng)
            if state is not None and (label := self._expert.label(state)).valid:
                break
        else:
            state, label = visited, self._expert.label(visited)
        if not label.valid:
            return []
        if self._scenes.branch_steps == 1:
            return [self._frame(state, replace(label, action=label.action + lead), seed)]
        return list(branch(self._env, self._expert, state, seed, self._scenes.branch_steps))

    def _frame(self, state: State, label: Label, seed: int) -> Transition:
        env, action = self._env, label.action
        env.set_state(state)
        return Transition(
            seed, state.step, state, env.observe(), label, action, Actor.EXPERT, 0.0, False, True, env.progress
        )
