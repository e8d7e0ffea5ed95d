"""The one loop, on an environment that is a number."""

from collections.abc import Sequence

import numpy as np
import pytest

from manip_il.collect.rollout import Rules, Turn, rollout
from manip_il.mdp import Actor, Label, Observation, State, Transition
from manip_il.world import Outcome

GOAL = 3.0


class Counter:
    """A number that actions add to; solved from `GOAL` on. Before step `kick` it is set back by 5.

    noise: added to every action. stuck: progress grows by a tenth a step up to this one, then by
    less than counts, and nothing is solved.
    """

    def __init__(self, kick: int = -1, noise: float = 0.0, stuck: int | None = None) -> None:
        self.x, self.steps, self.kick, self.noise, self.stuck = 0.0, 0, kick, noise, stuck

    @property
    def solved(self) -> bool:
        return self.x >= GOAL and self.stuck is None

    @property
    def progress(self) -> float:
        if self.stuck is not None:
            return 0.1 * min(self.steps, self.stuck) + 1e-6 * self.steps
        return min(1.0, max(0.0, self.x / GOAL))

    def start(self, seed: int) -> None:
        self.x, self.steps = 0.0, 0

    def step(self, action: np.ndarray) -> Outcome:
        self.x += float(action[0]) + self.noise
        self.steps += 1
        return Outcome(
            action + self.noise if self.noise else action, float(self.solved), self.solved
        )

    def observe(self) -> Observation:
        self.x -= 5.0 * (self.steps == self.kick)
        return Observation(np.array([self.x], np.float32), np.array([self.steps], np.float32))

    def get_state(self) -> State:
        return State(np.array([self.x]), np.zeros(0), step=self.steps)


class Ones:
    """An expert that always adds one; remembers in which steps it was queried."""

    def __init__(self) -> None:
        self.queried: list[int] = []

    def label(self, state: State, environment: object | None = None) -> Label:
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


def one_episode(
    env: Counter, driver, rules: Rules, gate=always, expert: Ones | None = None
) -> list[Transition]:
    return list(rollout([env], [0], driver, rules, expert or Ones(), gate))


def test_a_frame_holds_what_was_before_the_step_and_what_came_of_it():
    frames = one_episode(Counter(), follow, Rules(horizon=4))
    assert [frame.state.physics[0] for frame in frames] == [0, 1, 2, 3]
    assert [frame.observation.state[0] for frame in frames] == [0, 1, 2, 3]
    assert [frame.progress for frame in frames] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert [(frame.success, frame.reward) for frame in frames] == [
        (False, 0),
        (False, 0),
        (True, 1),
        (True, 1),
    ]


@pytest.mark.parametrize(
    ("env", "rules", "length"),
    [
        (Counter(), Rules(30, hold=0), 3),
        (Counter(), Rules(30, hold=2), 5),  # so long after success
        (Counter(kick=4), Rules(30, hold=3), 6),  # also if it is lost again
        (Counter(), Rules(30), 30),
        (Counter(stuck=5), Rules(30, patience=3), 9),  # so long after its last progress
        (Counter(stuck=5), Rules(30), 30),
    ],
)
def test_an_episode_ends_by_its_rules(env: Counter, rules: Rules, length: int):
    frames = one_episode(env, follow, rules)
    assert [frame.done for frame in frames] == [False] * (length - 1) + [True]


@pytest.mark.parametrize("steps", [[0, 1, 2, 3], [3], []])
def test_the_expert_is_queried_where_the_gate_says(steps: list[int]):
    expert = Ones()
    frames = one_episode(
        Counter(), Halves(), Rules(4), lambda turns, _: [one.step in steps for one in turns], expert
    )
    assert expert.queried == [frame.step for frame in frames if frame.label is not None] == steps


def test_an_expert_that_takes_over_has_a_horizon_more_and_leaves_the_others_alone():
    def gate(turns, actions):
        return [(turn.seed, turn.step) == (1, 2) for turn in turns]

    learner = Halves()
    frames = list(
        rollout([Counter(), Counter()], [0, 1], learner, Rules(5, takeover=True), Ones(), gate)
    )
    actors = {seed: [frame.actor for frame in frames if frame.seed == seed] for seed in (0, 1)}
    assert actors == {0: [Actor.LEARNER] * 5, 1: [Actor.LEARNER] * 2 + [Actor.EXPERT] * 8}
    assert learner.rows == [2, 2, 2, 1, 1]


@pytest.mark.parametrize(
    ("env", "driver", "executed", "actor"),
    [
        (Counter(), Halves(), 0.5, Actor.LEARNER),
        (Counter(noise=0.1), Halves(), 0.6, Actor.LEARNER),
        # as its action is changed on its way
        (Counter(noise=0.1), follow, 1.1, Actor.NOISY_EXPERT),
    ],
)
def test_the_label_is_the_experts_whoever_drove(env, driver, executed: float, actor: Actor):
    frames = one_episode(env, driver, Rules(4))
    assert [frame.label.action[0] for frame in frames] == [1.0] * 4
    assert [frame.executed_action[0] for frame in frames] == [executed] * 4
    assert {frame.actor for frame in frames} == {actor}
