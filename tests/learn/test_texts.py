"""Policies that read the task's text: the same numbers everywhere, and no word is an error."""

import numpy as np
import pytest
import torch
from lerobot.policies.factory import make_pre_post_processors

from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_write import write_dataset
from manip_il.errors import ManipError, UsageError
from manip_il.learn.export import export_onnx
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.mlp import MLPPolicy
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.texts import LENGTH, tokens
from manip_il.learn.train import Trainer
from manip_il.mdp import Episode

TEXTS = ("Open the door.", "Close the door.")


@pytest.fixture(scope="module")
def policy(spec, dataset, tmp_path_factory):
    """Trained on two tasks that only the text tells apart: their actions have opposite signs."""
    folder = tmp_path_factory.mktemp("texts")
    columns = dataset[0].columns()
    episodes = []
    for number, text in enumerate(TEXTS):
        found = {name: columns[name].reshape(len(dataset[0]), -1) for name in spec_columns(columns)}
        found["label_valid"] = np.ones_like(found["label_valid"])
        found["action"] = found["observation.state"] + np.float32(0.1 - 0.2 * number)
        episodes.append(Episode(number, found, True, True, instruction=text))
    write_dataset(episodes, folder / "data", spec, fingerprint={})
    fit = FitConfig({"width": 32}, steps=150, batch_size=64)
    return Trainer([Dataset.open(folder / "data")], fit, folder / "run").fit()


def spec_columns(columns):
    own = ("index", "episode_index", "frame_index", "task_index", "timestamp")
    return [name for name in columns if name not in own]


def test_a_text_has_the_same_numbers_everywhere_and_any_word_has_some():
    one, other, strange = tokens(["Open the door", "open THE door!", "Zyx \N{SNOWMAN} \u4e2d"])
    assert torch.equal(one, other)
    assert one[:4].tolist() == [1866, 1651, 432, 2335]
    assert strange.any()
    assert tokens(["word " * 9999, ""]).shape == (2, LENGTH)


def test_the_text_decides_where_nothing_else_does(policy, dataset):
    learned, states = LearnedPolicy.load(policy), dataset[0].columns(["observation.state"])
    seen = states["observation.state"][:6]
    around = dataset[0].columns(["observation.environment_state"])["observation.environment_state"][
        :6
    ]
    learned.begin(dict(enumerate(TEXTS * 3)))
    moved = learned.act(seen, around)[:, :-1] - seen[:, :-1]
    assert (np.sign(moved.mean(1)) == [1, -1] * 3).all()
    with pytest.raises(UsageError, match=r"^the policy reads the task's text, which is not given"):
        LearnedPolicy.load(policy).act(seen, around)
    learned.begin({7: TEXTS[1]})
    alone = learned.act(seen[1:2], around[1:2], episodes=[7])
    learned.begin(dict(enumerate(TEXTS * 3)))
    assert np.array_equal(learned.act(seen, around)[1:2], alone)
    theirs = MLPPolicy.from_pretrained(policy)
    before, after = make_pre_post_processors(theirs.config, pretrained_path=str(policy))
    batch = {
        "observation.state": torch.from_numpy(seen),
        "observation.environment_state": torch.from_numpy(around),
        "task": list(TEXTS * 3),
    }
    assert np.array_equal(
        after(theirs.select_action(before(batch))).numpy(), learned.act(seen, around)
    )


def test_one_that_reads_is_not_exported(policy):
    with pytest.raises(ManipError, match="reads the task's text"):
        export_onnx(policy)
