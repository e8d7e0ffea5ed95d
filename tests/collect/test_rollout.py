"""The one loop, on an environment that is a number."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
import pytest

from manip_il.collect.rollout import Rules, Turn, rollout
from manip_il.mdp import Actor, Label, Observation, State, Transition

GOAL = 3.0


class Counter:
    """A number that actions add to; solved from `GOAL` on. It starts at minus the seed's last digit."""

    def __init__(self) -> None:
        self.x, self.steps = 0.0, 0

    @property
    def solved(self) -> bool:
        return self.x >= GOAL

    world, task_description = None, ""

    @property
    def reward(self) -> float:
        return float(self.solved)

    @property
    def progress(self) -> float:
        return min(1.0, max(0.0, self.x / GOAL))

    def start(self, seed: int) -> None:
        self.x, self.steps = -float(seed % 10), 0

    def begin_step(self) -> None:
        """Nothing disturbs it."""

    def advance(self, action: np.ndarray) -> np.ndarray:
        self.x += float(action[0])
        self.steps += 1
        return action

    def observe(self) -> Observation:
        return Observation(np.array([self.x], np.float32), np.array([self.steps], np.float32))

    def get_state(self) -> State:
        return State(np.array([self.x]), np.empty(0), self.steps)

    def set_state(self, state: State) -> None:
        self.x, self.steps = float(state.physics[0]), state.step


class Kicked(Counter):
    """Its number is set back by 5 before one step, and every action is off by a tenth."""

    def __init__(self, at: int):
        super().__init__()
        self._at = at

    def begin_step(self) -> None:
        if self.steps == self._at:
            self.x -= 5.0

    def advance(self, action: np.ndarray) -> np.ndarray:
        return super().advance(action + 0.1)


class Slowing(Counter):
    """Its progress grows by a tenth a step, and from one step on by less than counts."""

    def __init__(self, until: int):
        super().__init__()
        self._until = until

    @property
    def solved(self) -> bool:
        return False

    @property
    def progress(self) -> float:
        return 0.1 * min(self.steps, self._until) + 1e-6 * self.steps


class Ones:
    """An expert that always adds one; remembers in which steps it was queried."""

    def __init__(self) -> None:
        self.queried: list[int] = []

    def label(self, state: State, world: object | None = None) -> Label:
        self.queried.append(state.step)
        return Label(np.array([1.0]), 1, True, 0.0)


class Halves:
    """A learner that adds a half; remembers how many rows it was given."""

    def __init__(self) -> None:
        self.rows: list[int] = []

    def __call__(self, turns: Sequence[Turn]) -> list[tuple[np.ndarray, Actor]]:
        self.rows.append(len(turns))
        return [(np.array([0.5]), Actor.LEARNER) for _ in turns]


def follow(turns: Sequence[Turn]) -> list[tuple[np.ndarray, Actor]]:
    """Executes the label."""
    return [(turn.query().action, Actor.EXPERT) for turn in turns]


def always(turns: Sequence[Turn], actions: Sequence[np.ndarray]) -> list[bool]:
    return [True] * len(turns)


def episodes(transitions) -> dict[int, list[Transition]]:
    frames = sorted(transitions, key=lambda t: (t.seed, t.step))
    return {seed: list(group) for seed, group in groupby(frames, key=lambda t: t.seed)}


def one_episode(env: Counter, driver, rules: Rules, gate=always) -> list[Transition]:
    return list(rollout([env], [0], driver, rules, Ones(), gate))


def test_a_frame_holds_what_was_before_the_step_and_what_came_of_it():
    frames = one_episode(Counter(), follow, Rules(horizon=4))
    assert [frame.state.physics[0] for frame in frames] == [0, 1, 2, 3]
    assert [frame.observation.state[0] for frame in frames] == [0, 1, 2, 3]
    assert [frame.progress for frame in frames] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert [(frame.success, frame.reward) for frame in frames] == [(False, 0), (False, 0), (True, 1), (True, 1)]


@pytest.mark.parametrize(("hold", "length"), [(0, 3), (2, 5), (None, 30)])
def test_hold_ends_an_episode_that_long_after_success(hold: int | None, length: int):
    frames = one_episode(Counter(), follow, Rules(30, hold))
    assert [frame.done for frame in frames] == [False] * (length - 1) + [True]


@pytest.mark.parametrize(("patience", "length"), [(3, 9), (None, 30)])
def test_an_episode_ends_that_long_after_its_last_progress(patience: int | None, length: int):
    frames = one_episode(Slowing(5), Halves(), Rules(30, patience=patience))
    assert [frame.done for frame in frames] == [False] * (length - 1) + [True]


def test_an_episode_goes_on_to_its_end_where_success_is_lost_again():
    frames = one_episode(Kicked(4), follow, Rules(30, hold=3))
    assert [frame.success for frame in frames] == [False, False, True, True, False, False]


@pytest.mark.parametrize("steps", [[0, 1, 2, 3], [3], []])
def test_the_expert_is_queried_where_the_gate_says(steps: list[int]):
    expert = Ones()
    chosen = rollout(
        [Counter()], [0], Halves(), Rules(4), expert, lambda turns, _: [one.step in steps for one in turns]
    )
    assert expert.queried == [frame.step for frame in chosen if frame.label is not None] == steps


def test_an_expert_that_takes_over_drives_to_the_end_and_leaves_the_others_alone():
    def gate(turns, actions):
        return [(turn.seed, turn.step) == (1, 2) for turn in turns]

    learner, rules = Halves(), Rules(5, takeover=True)
    found = episodes(rollout([Counter(), Counter()], [0, 1], learner, rules, Ones(), gate))
    assert [frame.actor for frame in found[0]] == [Actor.LEARNER] * 5
    assert [frame.actor for frame in found[1]] == [Actor.LEARNER] * 2 + [Actor.EXPERT] * 3
    assert learner.rows == [2, 2, 2, 1, 1]


@pytest.mark.parametrize(
    ("env", "driver", "executed", "actor"),
    [
        (Counter(), Halves(), 0.5, Actor.LEARNER),
        (Kicked(99), Halves(), 0.6, Actor.LEARNER),
        (Kicked(99), follow, 1.1, Actor.NOISY_EXPERT),  # as its action is changed on its way
    ],
)
def test_the_label_is_the_experts_whoever_drove(env, driver, executed: float, actor: Actor):
    frames = one_episode(env, driver, Rules(4))
    assert [frame.label.action[0] for frame in frames] == [1.0] * 4
    assert [frame.executed_action[0] for frame in frames] == [executed] * 4
    assert {frame.actor for frame in frames} == {actor}
