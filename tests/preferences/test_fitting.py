"""The Bradley-Terry reward: what it learns, that it is the same everywhere, and what a folder of
it may hold.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from manip_il.chapter.preferences.fitting import deal, fit_answers
from manip_il.chapter.preferences.pairs import Teacher, answer_pairs, join_answers
from manip_il.chapter.reward import LearnedReward, RewardShape, ways_of, write_reward
from manip_il.data.dataset import Dataset
from manip_il.errors import MismatchError

SHAPE = RewardShape(members=3, width=16)


@pytest.fixture(scope="module")
def answers(clips):
    return join_answers([answer_pairs(Teacher.parse("perfect"), clips, np.random.default_rng(0))])


@pytest.fixture(scope="module")
def fitted(clips, answers):
    return fit_answers(clips, answers, SHAPE, 0)


@pytest.fixture(scope="module")
def folder(fitted, clips, tmp_path_factory):
    made = tmp_path_factory.mktemp("reward")
    write_reward(made, fitted.network, clips.data.spec, {"seed": 0}, {})
    return made


def test_a_reward_learns_what_its_answers_are_about(fitted, clips):
    with torch.no_grad():
        reward = fitted.network(torch.from_numpy(clips.data.inputs)).numpy()
    assert np.corrcoef(reward, clips.data.progress)[0, 1] > 0.75
    left, right = clips.data.progress[clips.rows].mean(axis=-1).T
    told = np.abs(left - right) >= 0.01
    assert ((fitted.logits > 0) == (left > right))[told].mean() > 0.85
    assert np.quantile(reward, [0.01, 0.99]) == pytest.approx([0, 1], abs=0.02)


def test_a_pair_is_held_out_whole_and_every_fold_is_in_turn():
    pair = np.repeat(np.arange(30), 2)
    folds = deal(pair, 5, 0)
    assert (folds[::2] == folds[1::2]).all()
    assert np.bincount(folds).tolist() == [12] * 5


def test_what_is_said_of_a_held_out_pair_does_not_depend_on_its_answer(clips, answers):
    """Answers of one fold turned round change the networks that learn from them, not the one that
    leaves them out.

    The number of epochs is chosen by all answers, so both fits are of one epoch.
    """
    folds = deal(answers.pair, 3, 0)
    turned = np.where(folds == 1, 1 - answers.better, answers.better)
    said = []
    for better in (answers.better, turned):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("manip_il.chapter.preferences.fitting._EPOCHS", 1)
            said.append(fit_answers(clips, replace(answers, better=better), SHAPE, 0).logits)
    assert said[0][folds == 1] == pytest.approx(said[1][folds == 1], abs=1e-6)
    assert not np.allclose(said[0][folds == 2], said[1][folds == 2], atol=1e-6)


def test_the_same_seed_gives_the_same_weights(fitted, clips, answers):
    again = fit_answers(clips, answers, SHAPE, 0).network.state_dict()
    assert all(
        torch.equal(value, again[name]) for name, value in fitted.network.state_dict().items()
    )


def test_ways_are_the_triples_that_lead_from_one_thing_to_another(spec):
    names = (
        "ee.x",
        "goal_from_object.x",
        "goal_from_object.y",
        "goal_from_object.z",
        "object_from_ee.x",
    )
    assert ways_of(replace(spec, environment_state_names=names)) == ((4, 5, 6), (4, 5))


def test_a_reward_is_for_one_task_and_observation(folder, clips, datasets):
    reward = LearnedReward.load(folder)
    reward.check_fits("here", clips.data.spec)
    with pytest.raises(
        MismatchError, match=r"task differs: the reward has lift, .*other has reach"
    ):
        reward.check_fits(str(datasets / "other"), Dataset.open(datasets / "other").spec)
