"""Who drives, and when the expert is queried: each driver and each rule."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from kept import written

from manip_il.collect.drivers import (
    PolicyDriver,
    RandomDriver,
    Setting,
    expert_actions,
    learner_actions,
    mixture,
)
from manip_il.collect.expert import Expert
from manip_il.collect.query import (
    Ensemble,
    Every,
    Likelihood,
    One,
    Probability,
    Safety,
    action_gap,
    drawn_step,
    parse_query,
)
from manip_il.collect.rollout import Rules, Turn, rollout
from manip_il.data.episodes import group_rollouts, to_episode
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.mdp import Actor, Episode, Label, Observation, State
from manip_il.seeding import stream_seeds
from manip_il.sim.env import ManipEnv
from manip_il.sim.scene import build_scene

SEEDS = stream_seeds("certificate", 5)
STATE = State(np.zeros(4), np.zeros(3))
RULES = Rules(horizon=15)
SCALE = np.array([0.1, 0.1, 0.08])


def setting(*policies, horizon: int = 15) -> Setting:
    return Setting(SimpleNamespace(scale=SCALE), horizon, policies)  # pyright: ignore[reportArgumentType]


class Wave:
    """A policy without weights: every joint waves with the hand's place."""

    cameras = ()

    def act(self, states: np.ndarray, environment_states: np.ndarray, images=None, episodes=None) -> np.ndarray:
        place = environment_states[:, :1].astype(np.float64) + environment_states[:, 1:2]
        return states.astype(np.float64) + 0.05 * np.sin(20 * place + np.arange(states.shape[1]))

    def reset(self, episodes) -> None:
        """It has no memory."""


class Diary(Wave):
    """Notes which episodes begin, whose rows are asked, and how bright the front camera's pictures are."""

    cameras = ("front",)

    def __init__(self) -> None:
        self.notes: list = []

    def act(self, states, environment_states, images=None, episodes=None):
        self.notes.append((list(episodes), {name: picture[:, 0, 0, 0].tolist() for name, picture in images.items()}))
        return super().act(states, environment_states)

    def reset(self, episodes) -> None:
        self.notes.append(("reset", list(episodes)))


class Reader(Diary):
    """Notes what it is told of episodes that begin, too."""

    def instruct(self, instructions) -> None:
        self.notes.append(("told", dict(instructions)))


class Teacher:
    """An expert of one answer, which counts its queries."""

    def __init__(self, *action: float):
        self.action, self.queries = np.array(action), 0

    def label(self, state: State, world=None) -> Label:
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

    def require_likelihood(self) -> None:
        """It has one."""

    def log_prob(self, states, environment_states, images, actions):
        return -actions.shape[1] * states[:, 0].astype(np.float64)


def run(act, robot: str = "fetch") -> list[Episode]:
    env, every = ManipEnv(robot), Every().start(setting())
    steps = rollout([env], SEEDS, act, RULES, Expert(env.scene), every)
    return [to_episode(frames) for frames in group_rollouts(steps)]


def turn(seed: int = 0, step: int = 0, value: float = 0.0, teacher: Teacher | None = None) -> Turn:
    images = {name: np.full((2, 2, 3), seed + step, np.uint8) for name in ("front", "wrist")}
    observation = Observation(np.full(3, value, np.float32), np.zeros(2, np.float32), images, f"do {seed}")
    return Turn(seed, step, observation, STATE, teacher)


@pytest.mark.parametrize(("beta", "alone"), [(1.0, expert_actions), (0.0, learner_actions(Wave()))])
def test_a_mixture_of_one_alone_is_its_run(beta: float, alone):
    assert written(run(mixture(learner_actions(Wave()), beta))) == written(run(alone))


def test_a_mixture_executes_either_the_label_or_the_learners_action():
    for episode in run(mixture(learner_actions(Wave()), 0.5)):
        columns = episode.columns
        by_expert = columns["actor"].ravel() == Actor.EXPERT
        assert 0 < by_expert.sum() < len(episode)
        np.testing.assert_array_equal(columns["executed_action"][by_expert], columns["action"][by_expert])
        learner = Wave().act(columns["observation.state"], columns["observation.environment_state"])
        np.testing.assert_array_equal(columns["executed_action"][~by_expert], learner.astype(np.float32)[~by_expert])


@pytest.mark.parametrize("beta", [0.2, 0.8])
def test_beta_is_the_experts_share_of_the_steps(beta: float):
    driver = mixture(learner_actions(Wave()), beta)
    turns = [turn(seed, teacher=Teacher(1.0, 1.0, 1.0)) for seed in range(20)]
    actors = [actor for _ in range(50) for _, actor in driver(turns)]
    share = np.mean([actor == Actor.EXPERT for actor in actors])
    assert share == pytest.approx(beta, abs=5 * np.sqrt(beta * (1 - beta) / len(actors)))


def test_a_random_driver_stays_within_its_reach():
    actions = build_scene("panda", "reach").actions
    for episode in run(RandomDriver().start(Setting(actions, 15)), robot="panda"):
        step = np.subtract(episode.columns["executed_action"], episode.columns["observation.state"])
        assert (np.abs(step) <= actions.scale + 1e-6)[:, actions.arm].all()
        openings = episode.columns["executed_action"][:, actions.gripper]
        assert actions.low[actions.gripper] - 1e-6 <= openings.min()
        assert openings.max() <= actions.high[actions.gripper] + 1e-6


@pytest.mark.parametrize("beta", [0.0, 0.5])
def test_a_learner_is_told_whose_turn_it_is_and_sees_the_pictures_of_its_cameras(beta: float):
    diary = Diary()
    driver = PolicyDriver((Path("x"),), beta).start(setting(diary))
    taught = partial(turn, teacher=Teacher(1.0, 1.0, 1.0))
    driver([taught(10, 0), taught(20, 4)])
    driver([taught(10, 1), taught(20, 0)])
    driver([taught(10, 2)])
    assert diary.notes == [
        ("reset", [10]),
        ([10, 20], {"front": [10, 24]}),
        ("reset", [20]),
        ([10, 20], {"front": [11, 20]}),
        ([10], {"front": [12]}),
    ]


def test_a_learner_that_reads_is_told_the_text_of_an_episode_as_it_begins():
    reader = Reader()
    learner_actions(reader)([turn(10, 0), turn(20, 4)])
    assert reader.notes[:2] == [("reset", [10]), ("told", {10: "do 10"})]


@pytest.mark.parametrize("driver", [expert_actions, mixture(learner_actions(Wave()), 1.0)])
def test_an_expert_that_drives_must_be_there_to_ask(driver):
    with pytest.raises(ManipError, match=rf"episode {SEEDS[0]}: nobody to ask for a label at step 0"):
        list(rollout([ManipEnv("panda", "reach")], SEEDS[:1], driver, Rules(horizon=6)))


@pytest.mark.parametrize("text", ["every", "one", "probability:0.1", "ensemble:0.2", "likelihood:-2", "safety:0.5"])
def test_a_rule_is_written_as_it_is_read(text: str):
    assert str(parse_query(text)) == text


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
        parse_query(text)


def test_differences_are_measured_in_steps_of_the_worst_dimension():
    left, right = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), np.array([[0.05, 0.02, 0.0], [0.1, 0.0, 0.08]])
    assert action_gap(left, right, SCALE) == pytest.approx([0.5, 1.0])


def test_safety_queries_where_expert_and_learner_differ_by_more_than_the_bound():
    teacher = Teacher(0.0, 0.0, 0.08)
    turns = [turn(teacher=teacher), turn(teacher=teacher)]
    gate = Safety(0.5).start(setting())
    assert gate(turns, [np.array([0.04, 0.0, 0.08]), np.array([0.06, 0.0, 0.08])]) == [False, True]
    assert [one.label for one in turns] == [None, None]  # knowing is not keeping


def test_an_ensemble_queries_where_its_members_spread():
    others = [Constant(0.0, 0.0, 0.08), Constant(0.0, 0.0, 0.08)]
    gate = Ensemble(0.2).start(setting(Constant(), *others))
    agreed, alone = np.array([0.0, 0.0, 0.08]), np.array([0.09, 0.0, 0.08])
    assert gate([turn(7), turn(8, step=3)], [agreed, alone]) == [False, True]
    assert [member.begun for member in others] == [[7], [7]]  # a policy with a memory must know who begins


def test_an_unsure_learner_queries():
    gate = Likelihood(-1.0).start(setting(Doubtful()))
    assert gate([turn(value=0.5), turn(value=2.0)], [np.zeros(3)] * 2) == [False, True]


def test_chance_queries_in_its_share_of_the_steps_and_the_same_for_a_seed():
    def queried(seeds) -> np.ndarray:
        gate = Probability(0.3).start(setting())
        return np.array([gate([turn(seed, step) for seed in seeds], []) for step in range(200)])

    both = queried([1, 2])
    assert both.mean() == pytest.approx(0.3, abs=5 * math.sqrt(0.3 * 0.7 / both.size))
    assert np.array_equal(queried([2])[:, 0], both[:, 1])


def test_one_step_of_an_episode_is_drawn_evenly():
    drawn = [drawn_step(seed, 10) for seed in range(2_000)]
    assert np.bincount(drawn, minlength=10) == pytest.approx(200, abs=5 * math.sqrt(180))
    gate = One().start(setting(horizon=10))
    assert [gate([turn(3, step)], []) for step in range(10)].index([True]) == drawn[3]


def test_a_turn_queries_once_and_only_where_there_is_an_expert():
    teacher = Teacher(0.0, 0.0, 0.0)
    one = turn(teacher=teacher)
    assert one.query() is one.query() is one.label
    assert teacher.queries == 1
    with pytest.raises(ManipError, match="episode 4: nobody to ask for a label at step 9"):
        turn(4, 9).query()
