"""When the expert is queried: each gate's rule, and what it refuses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from manip_il.engine.drivers import (
    QueryRule,
    action_gap,
    at_drawn_step,
    by_chance,
    drawn_step,
    on_disagreement,
    on_gap,
    on_low_likelihood,
)
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.mdp import Label, Observation, State
from manip_il.rollout import Turn

SCALE = np.array([0.1, 0.1, 0.08])
STATE = State(np.zeros(4), np.zeros(3))


class Teacher:
    """An expert of one answer, which counts its queries."""

    def __init__(self, *action: float):
        self.action, self.queries = np.array(action), 0

    def label(self, state: State) -> Label:
        self.queries += 1
        return Label(self.action, 5, True, 0.0)


class Constant:
    """A policy of one answer."""

    cameras = ()

    def __init__(self, *action: float):
        self.action, self.begun = np.array(action), []

    def act(self, states, environment_states, images, episodes):
        return np.tile(self.action, (len(states), 1))

    def reset(self, episodes) -> None:
        self.begun += list(episodes)


class Doubtful:
    """Finds an action the less likely, the larger the state."""

    cameras = ()

    def log_prob(self, states, environment_states, images, actions):
        return -actions.shape[1] * states[:, 0].astype(np.float64)


def turn(seed: int = 0, step: int = 0, value: float = 0.0, teacher: Teacher | None = None) -> Turn:
    return Turn(seed, step, Observation(np.full(3, value, np.float32), np.zeros(2, np.float32)), STATE, teacher)


@pytest.mark.parametrize("text", ["every", "one", "probability:0.1", "ensemble:0.2", "likelihood:-2", "safety:0.5"])
def test_a_rule_is_written_as_it_is_read(text: str):
    assert str(QueryRule.parse(text)) == text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("evry", "did you mean 'every'"),
        ("every:1", "expected every alone"),
        ("probability", "expected probability:NUMBER"),
        ("probability:0", "more than 0, at most 1"),
        ("probability:1.5", "more than 0, at most 1"),
        ("safety:-1", "0 or more"),
        ("ensemble:nan", "0 or more"),
        ("likelihood:inf", "finite"),
        ("likelihood:", "NUMBER"),
    ],
)
def test_a_rule_that_cannot_be_is_refused_with_what_can(text: str, says: str):
    with pytest.raises((UsageError, UnknownName), match=says):
        QueryRule.parse(text)


def test_differences_are_measured_in_steps_of_the_worst_dimension():
    left, right = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), np.array([[0.05, 0.02, 0.0], [0.1, 0.0, 0.08]])
    assert action_gap(left, right, SCALE) == pytest.approx([0.5, 1.0])


def test_safety_queries_where_expert_and_learner_differ_by_more_than_the_bound():
    teacher = Teacher(0.0, 0.0, 0.08)
    turns = [turn(teacher=teacher), turn(teacher=teacher)]
    gate = on_gap(0.5, SCALE)
    assert gate(turns, [np.array([0.04, 0.0, 0.08]), np.array([0.06, 0.0, 0.08])]) == [False, True]
    assert [one.label for one in turns] == [None, None]  # knowing is not keeping


def test_an_ensemble_queries_where_its_members_spread():
    others = [Constant(0.0, 0.0, 0.08), Constant(0.0, 0.0, 0.08)]
    gate = on_disagreement(0.2, others, SCALE)
    agreed, alone = np.array([0.0, 0.0, 0.08]), np.array([0.09, 0.0, 0.08])
    assert gate([turn(7), turn(8, step=3)], [agreed, alone]) == [False, True]
    assert [member.begun for member in others] == [[7], [7]]  # a policy with a memory must know who begins


def test_an_unsure_learner_queries():
    assert on_low_likelihood(-1.0, Doubtful())([turn(value=0.5), turn(value=2.0)], [np.zeros(3)] * 2) == [False, True]


def test_chance_queries_in_its_share_of_the_steps_and_the_same_for_a_seed():
    def queried(seeds) -> np.ndarray:
        gate = by_chance(0.3)
        return np.array([gate([turn(seed, step) for seed in seeds], []) for step in range(200)])

    both = queried([1, 2])
    assert both.mean() == pytest.approx(0.3, abs=5 * math.sqrt(0.3 * 0.7 / both.size))
    assert np.array_equal(queried([2])[:, 0], both[:, 1])


def test_one_step_of_an_episode_is_drawn_evenly():
    drawn = [drawn_step(seed, 10) for seed in range(2_000)]
    assert np.bincount(drawn, minlength=10) == pytest.approx(200, abs=5 * math.sqrt(180))
    gate = at_drawn_step(10)
    assert [gate([turn(3, step)], []) for step in range(10)].index([True]) == drawn[3]


def test_a_turn_queries_once_and_only_where_there_is_an_expert():
    teacher = Teacher(0.0, 0.0, 0.0)
    one = turn(teacher=teacher)
    assert one.query() is one.query() is one.label
    assert teacher.queries == 1
    with pytest.raises(ManipError, match="episode 4: nobody to ask for a label at step 9"):
        turn(4, 9).query()
