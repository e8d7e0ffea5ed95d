"""The one loop, on an environment that is a number."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
import pytest

from manip_il.mdp import Actor, Label, Observation, State, Transition
from manip_il.rollout import Rules, Turn, rollout

GOAL = 3.0


class Counter:
    """A number that actions add to; solved from `GOAL` on. It starts at minus the seed's last digit."""

    def __init__(self) -> None:
        self.x, self.steps = 0.0, 0

    @property
    def solved(self) -> bool:
        return self.x >= GOAL

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


class Ones:
    """An expert that always adds one; remembers in which steps it was asked."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def label(self, state: State) -> Label:
        self.asked.append(state.step)
        return Label(np.array([1.0]), 1, True, 0.0)


class Halves:
    """A learner that adds a half; remembers how many rows it was given."""

    def __init__(self) -> None:
        self.rows: list[int] = []

    def act(self, turns: Sequence[Turn]) -> list[tuple[np.ndarray, Actor]]:
        self.rows.append(len(turns))
        return [(np.array([0.5]), Actor.LEARNER) for _ in turns]


class Follow:
    """Executes the label."""

    def act(self, turns: Sequence[Turn]) -> list[tuple[np.ndarray, Actor]]:
        return [(turn.label.action, Actor.EXPERT) for turn in turns]


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


def episodes(transitions) -> dict[int, list[Transition]]:
    frames = sorted(transitions, key=lambda t: (t.seed, t.step))
    return {seed: list(group) for seed, group in groupby(frames, key=lambda t: t.seed)}


def columns(frames: list[Transition]) -> list[tuple]:
    return [
        (t.step, t.state.physics[0], t.observation.state[0], t.executed_action[0], t.actor, t.success, t.done)
        for t in frames
    ]


@pytest.mark.parametrize("envs", [1, 2, 3, 7])
def test_every_seed_is_one_whole_episode(envs: int):
    seen = episodes(rollout([Counter() for _ in range(envs)], range(5), Halves(), Rules(horizon=4)))
    assert list(seen) == list(range(5))
    for frames in seen.values():
        assert [frame.step for frame in frames] == [0, 1, 2, 3]
        assert [frame.done for frame in frames] == [False, False, False, True]


@pytest.mark.parametrize("envs", [2, 5])
def test_an_episode_does_not_depend_on_its_neighbours(envs: int):
    def run(count: int) -> dict[int, list[tuple]]:
        found = rollout([Kicked(3) for _ in range(count)], range(9), Follow(), Rules(horizon=20, hold=1), Ones())
        return {seed: columns(frames) for seed, frames in episodes(found).items()}

    assert run(envs) == run(1)


def test_no_seeds_give_nothing():
    assert list(rollout([Counter()], [], Halves(), Rules(horizon=4))) == []


def test_environments_without_a_seed_left_do_not_run():
    driver = Halves()
    list(rollout([Counter() for _ in range(4)], range(6), driver, Rules(horizon=3)))
    assert driver.rows == [4, 4, 4, 2, 2, 2]


def test_a_frame_holds_what_was_before_the_step_and_what_came_of_it():
    frames = episodes(rollout([Counter()], [0], Follow(), Rules(horizon=4), Ones()))[0]
    assert [frame.state.physics[0] for frame in frames] == [0, 1, 2, 3]
    assert [frame.observation.state[0] for frame in frames] == [0, 1, 2, 3]
    assert [frame.success for frame in frames] == [False, False, True, True]
    assert [frame.reward for frame in frames] == [0, 0, 1, 1]


def test_progress_is_that_of_the_state_before_the_step():
    frames = episodes(rollout([Counter()], [0], Follow(), Rules(horizon=4), Ones()))[0]
    assert [frame.progress for frame in frames] == pytest.approx([0, 1 / 3, 2 / 3, 1])


@pytest.mark.parametrize("envs", [1, 3])
def test_the_last_frame_alone_has_what_was_seen_after_it(envs: int):
    rules = Rules(horizon=6, hold=1)
    found = episodes(rollout([Counter() for _ in range(envs)], range(4), Follow(), rules, Ones()))
    for frames in found.values():
        assert all(frame.final is None for frame in frames[:-1])
        last = frames[-1]
        assert last.done
        # One action on from the last state, though the environment may have begun another episode by now.
        assert last.final.state[0] == last.state.physics[0] + last.executed_action[0]
        assert last.final.environment_state[0] == len(frames)


@pytest.mark.parametrize(("hold", "length"), [(0, 3), (2, 5), (None, 30)])
def test_hold_ends_an_episode_that_long_after_success(hold: int | None, length: int):
    frames = episodes(rollout([Counter()], [0], Follow(), Rules(30, hold), Ones()))[0]
    assert len(frames) == length
    assert [frame.done for frame in frames] == [False] * (length - 1) + [True]


def test_an_episode_goes_on_to_its_end_where_success_is_lost_again():
    frames = episodes(rollout([Kicked(4)], [0], Follow(), Rules(30, hold=3), Ones()))[0]
    assert [frame.success for frame in frames] == [False, False, True, True, False, False]


@pytest.mark.parametrize(("query", "asked"), [("every", [0, 1, 2, 3]), ("last", [3]), ("driver", [])])
def test_the_expert_is_asked_where_the_rules_say(query, asked: list[int]):
    expert = Ones()
    frames = episodes(rollout([Counter()], [0], Halves(), Rules(4, query=query), expert))[0]
    assert expert.asked == asked
    assert [frame.step for frame in frames if frame.label is not None] == asked


def test_the_label_is_the_experts_whoever_drove():
    frames = episodes(rollout([Counter()], [0], Halves(), Rules(4), Ones()))[0]
    assert [frame.label.action[0] for frame in frames] == [1.0] * 4
    assert [frame.executed_action[0] for frame in frames] == [0.5] * 4
    assert {frame.actor for frame in frames} == {Actor.LEARNER}


def test_an_expert_whose_action_is_changed_on_its_way_is_a_noisy_one():
    frames = episodes(rollout([Kicked(99)], [0], Follow(), Rules(4), Ones()))[0]
    assert {frame.actor for frame in frames} == {Actor.NOISY_EXPERT}
    assert [frame.label.action[0] for frame in frames] == [1.0] * 4
    assert [frame.executed_action[0] for frame in frames] == [1.1] * 4
    learner = episodes(rollout([Kicked(99)], [0], Halves(), Rules(4), Ones()))[0]
    assert {frame.actor for frame in learner} == {Actor.LEARNER}


def test_a_disturbance_happens_before_the_state_is_read():
    frames = episodes(rollout([Kicked(1)], [0], Halves(), Rules(3)))[0]
    assert [frame.state.physics[0] for frame in frames] == pytest.approx([0, 0.6 - 5, 1.2 - 5])
    assert [frame.observation.state[0] for frame in frames] == pytest.approx([0, 0.6 - 5, 1.2 - 5])
