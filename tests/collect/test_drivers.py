"""Who drives, and when the expert is queried: each driver and each rule."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from manip_il.collect.drivers import PolicyDriver, RandomDriver, Setting
from manip_il.collect.query import Query, drawn_step
from manip_il.collect.rollout import Turn
from manip_il.mdp import Actor, Label, Observation, State
from manip_il.worlds.ladder.world import scene_of

STATE = State(np.zeros(4), np.zeros(3))
SCALE = np.array([0.1, 0.1, 0.08])


def setting(*policies, horizon: int = 15) -> Setting:
    return Setting(SimpleNamespace(scale=SCALE), horizon, policies)


class Teacher:
    """An expert of one answer."""

    def __init__(self, *action: float):
        self.action = np.array(action)

    def label(self, state: State, world=None) -> Label:
        return Label(self.action, 5, True, 0.0)


class Diary:
    """A policy of one answer that notes what it is told: who begins and of what, whose rows,
    what pictures.
    """

    cameras = ("front",)

    def __init__(self, *action: float) -> None:
        self.action, self.notes = np.array(action), list()

    def act(self, states, environment_states, images, episodes):
        self.notes.append((list(episodes), images["front"][:, 0, 0, 0].tolist()))
        return np.tile(self.action, (len(states), 1))

    def begin(self, instructions) -> None:
        self.notes.append(("begin", dict(instructions)))


def turn(seed: int = 0, step: int = 0, value: float = 0.0, teacher: Teacher | None = None) -> Turn:
    images = {name: np.full((2, 2, 3), seed + step, np.uint8) for name in ("front", "wrist")}
    observation = Observation(
        np.full(3, value, np.float32), np.zeros(2, np.float32), images, f"do {seed}"
    )
    return Turn(seed, step, observation, STATE, teacher)


@pytest.mark.parametrize("beta", [0.0, 0.2, 1.0])
def test_a_mixture_executes_the_label_with_probability_beta_else_the_learners_action(beta: float):
    driver = PolicyDriver(beta=beta).start(setting(Diary(0.0, 0.0, 0.0)))
    turns = [turn(seed, step=1, teacher=Teacher(1.0, 1.0, 1.0)) for seed in range(20)]
    chosen = [one for _ in range(50) for one in driver(turns)]
    assert all(action[0] == (actor == Actor.EXPERT) for action, actor in chosen)
    share = np.mean([actor == Actor.EXPERT for _, actor in chosen])
    assert share == pytest.approx(beta, abs=5 * np.sqrt(beta * (1 - beta) / len(chosen)))


def test_a_random_driver_stays_within_its_reach():
    actions = scene_of("panda", "reach").actions
    drive = RandomDriver().start(Setting(actions, 15))
    state = np.asarray([*np.linspace(-1, 1, 7), 0.04], np.float32)
    turns = [
        Turn(seed, 0, Observation(state, np.zeros(0, np.float32)), STATE) for seed in range(99)
    ]
    drawn = np.array([[action for action, _ in drive(turns)] for _ in range(2)])
    assert (np.abs(drawn - state) <= actions.scale + 1e-6)[..., actions.arm].all()
    opening = drawn[..., actions.gripper]
    assert (
        (opening >= actions.low[actions.gripper]) & (opening <= actions.high[actions.gripper])
    ).all()
    assert (drawn[0] != drawn[1]).any(axis=1).all()


def test_a_learner_is_told_whose_turn_it_is_and_of_what_and_sees_the_pictures_of_its_cameras():
    diary = Diary(0.0, 0.0, 0.0)
    driver = PolicyDriver().start(setting(diary))
    for step in ([turn(10, 0), turn(20, 4)], [turn(10, 1), turn(20, 0)], [turn(10, 2)]):
        driver(step)
    assert diary.notes == [
        *(("begin", {10: "do 10"}), ([10, 20], [10, 24])),
        *(("begin", {20: "do 20"}), ([10, 20], [11, 20])),
        ([10], [12]),
    ]


def test_safety_queries_where_expert_and_learner_differ_by_more_than_the_bound():
    turns = [turn(teacher=Teacher(0.0, 0.0, 0.08)) for _ in range(2)]
    gate = Query("safety", 0.5).start(setting())
    assert gate(turns, [np.array([0.04, 0.0, 0.08]), np.array([0.06, 0.0, 0.08])]) == [False, True]
    assert [one.label for one in turns] == [None, None]  # knowing is not keeping


def test_an_ensemble_queries_where_its_members_spread():
    others = [Diary(0.0, 0.0, 0.08), Diary(0.0, 0.0, 0.08)]
    gate = Query("ensemble", 0.2).start(setting(None, *others))
    agreed, alone = np.array([0.0, 0.0, 0.08]), np.array([0.09, 0.0, 0.08])
    assert gate([turn(7), turn(8, step=3)], [agreed, alone]) == [False, True]
    # a memory must know who begins
    assert [member.notes[0] for member in others] == [("begin", {7: "do 7"})] * 2


def test_chance_queries_in_its_share_of_the_steps_and_the_same_for_a_seed():
    def queried(seeds) -> np.ndarray:
        gate = Query("probability", 0.3).start(setting())
        return np.array([gate([turn(seed, step) for seed in seeds], []) for step in range(200)])

    both = queried([1, 2])
    assert both.mean() == pytest.approx(0.3, abs=5 * math.sqrt(0.3 * 0.7 / both.size))
    assert np.array_equal(queried([2])[:, 0], both[:, 1])


def test_one_step_of_an_episode_is_drawn_evenly():
    drawn = [drawn_step(seed, 10) for seed in range(2_000)]
    assert np.bincount(drawn, minlength=10) == pytest.approx(200, abs=5 * math.sqrt(180))
    gate = Query("one").start(setting(horizon=10))
    assert [gate([turn(3, step)], []) for step in range(10)].index([True]) == drawn[3]
