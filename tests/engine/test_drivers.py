"""Who drives, and that the labels are the expert's whoever does."""

from __future__ import annotations

import numpy as np
import pytest
from kept import written

from manip_il.data.episodes import group_rollouts, to_episode
from manip_il.engine.drivers import ExpertDriver, LearnerDriver, MixtureDriver, RandomDriver
from manip_il.errors import ManipError
from manip_il.expert import Expert
from manip_il.mdp import Actor, Episode, Label, Observation, State
from manip_il.rollout import Rules, Turn, rollout
from manip_il.seeding import stream_seeds
from manip_il.sim.env import ManipEnv
from manip_il.sim.scene import build_scene

SEEDS = stream_seeds("certificate", 5)
STATE = State(np.zeros(4), np.zeros(3))
RULES = Rules(horizon=15)


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


def run(driver, robot: str = "fetch") -> list[Episode]:
    env = ManipEnv(robot)
    return [to_episode(frames) for frames in group_rollouts(rollout([env], SEEDS, driver, RULES, Expert(env.scene)))]


def turn(seed: int, step: int) -> Turn:
    images = {name: np.full((2, 2, 3), seed + step, np.uint8) for name in ("front", "wrist")}
    observation = Observation(np.zeros(8, np.float32), np.zeros(3, np.float32), images)
    return Turn(seed, step, observation, STATE, label=Label(np.ones(8), 5, True, 0.0))


@pytest.mark.parametrize(("beta", "alone"), [(1.0, ExpertDriver()), (0.0, LearnerDriver(Wave()))])
def test_a_mixture_of_one_alone_is_its_run(beta: float, alone):
    assert written(run(MixtureDriver(Wave(), beta))) == written(run(alone))


def test_a_mixture_executes_either_the_label_or_the_learners_action():
    for episode in run(MixtureDriver(Wave(), 0.5)):
        columns = episode.columns
        by_expert = columns["actor"].ravel() == Actor.EXPERT
        assert 0 < by_expert.sum() < len(episode)
        np.testing.assert_array_equal(columns["executed_action"][by_expert], columns["action"][by_expert])
        learner = Wave().act(columns["observation.state"], columns["observation.environment_state"])
        np.testing.assert_array_equal(columns["executed_action"][~by_expert], learner.astype(np.float32)[~by_expert])


@pytest.mark.parametrize("beta", [0.2, 0.8])
def test_beta_is_the_experts_share_of_the_steps(beta: float):
    driver = MixtureDriver(Wave(), beta)
    turns = [turn(seed, 0) for seed in range(20)]
    actors = [actor for _ in range(50) for _, actor in driver.act(turns)]
    share = np.mean([actor == Actor.EXPERT for actor in actors])
    assert share == pytest.approx(beta, abs=5 * np.sqrt(beta * (1 - beta) / len(actors)))


def test_a_random_driver_stays_within_its_reach():
    actions = build_scene("panda", "reach").actions
    for episode in run(RandomDriver(actions), robot="panda"):
        step = np.subtract(episode.columns["executed_action"], episode.columns["observation.state"])
        assert (np.abs(step) <= actions.scale + 1e-6)[:, actions.arm].all()
        openings = episode.columns["executed_action"][:, actions.gripper]
        assert actions.low[actions.gripper] - 1e-6 <= openings.min()
        assert openings.max() <= actions.high[actions.gripper] + 1e-6


@pytest.mark.parametrize("make", [LearnerDriver, lambda policy: MixtureDriver(policy, 0.5)])
def test_a_learner_is_told_whose_turn_it_is_and_sees_the_pictures_of_its_cameras(make):
    diary = Diary()
    driver = make(diary)
    driver.act([turn(10, 0), turn(20, 4)])
    driver.act([turn(10, 1), turn(20, 0)])
    driver.act([turn(10, 2)])
    assert diary.notes == [
        ("reset", [10]),
        ([10, 20], {"front": [10, 24]}),
        ("reset", [20]),
        ([10, 20], {"front": [11, 20]}),
        ([10], {"front": [12]}),
    ]


@pytest.mark.parametrize("driver", [ExpertDriver(), MixtureDriver(Wave(), 1.0)])
def test_an_expert_that_drives_must_be_there_to_ask(driver):
    with pytest.raises(ManipError, match=rf"episode {SEEDS[0]}: nobody to ask for a label at step 0"):
        list(rollout([ManipEnv("panda", "reach")], SEEDS[:1], driver, Rules(horizon=6, query="driver")))
