"""Rewards of `carry`: read from a name, a file or a text, refused in one line, and kept as numbers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.collect.environments import env_fingerprint
from manip_il.errors import UsageError
from manip_il.tasks.config import make_config
from manip_il.tasks.reward import FEATURES, TASTES, Reward

numbers = st.floats(0, 1e6, allow_subnormal=False)


@given(st.lists(numbers, min_size=len(FEATURES), max_size=len(FEATURES)))
def test_a_reward_is_read_back_exactly_from_its_numbers(weights: list[float]):
    reward = Reward((max(weights[0], 0.1), *weights[1:]))
    assert Reward.parse(reward.numbers) == reward


@pytest.mark.parametrize("taste", TASTES)
def test_a_shipped_taste_is_read_by_its_name(taste: str):
    assert Reward.parse(taste) == TASTES[taste]
    assert TASTES[taste].text == taste
    assert Reward.parse(TASTES[taste].numbers).text == taste


def test_files_of_both_kinds_hold_a_reward(tmp_path: Path):
    listed = {"names": ["near_vase", "length"], "weights": [2.5, 1], "intervals": [[2, 3], [1, 1]], "method": "any"}
    (tmp_path / "reward.json").write_text(json.dumps(listed))
    (tmp_path / "own.yaml").write_text("length: 1\nnear_vase: 2.5\n")
    expected = Reward.parse("length=1, near_vase=2.5")
    assert expected.text == "length=1,near_vase=2.5"
    assert Reward.parse(str(tmp_path / "reward.json")) == Reward.parse(str(tmp_path / "own.yaml")) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("length=1,near_vose=2", "unknown feature 'near_vose' .did you mean 'near_vase'"),
        ("carful", "unknown reward 'carful' .did you mean 'careful'.*expected careful, low, hasty, a file of"),
        ("length=0,height=1", "weight of length is 0; expected more than 0"),
        ("height=1", "without a weight of length"),
        ("length=1,height=-2", "weight of height is -2; expected a finite number from 0"),
        ("length=1,height=nan", "weight of height is nan; expected a finite number"),
        ("length=1,height=much", "weight of height is 'much'; expected a number"),
        ("length=1,height", "'height' in a reward; expected NAME=NUMBER"),
        ("length=1,length=2", "length stands twice"),
        ("/nowhere/reward.json", "cannot read /nowhere/reward.json"),
    ],
)
def test_what_is_no_reward_is_refused_in_one_line(text: str, message: str):
    with pytest.raises(UsageError, match=message) as caught:
        Reward.parse(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", '{"names": ["length", "neer_vase"], "weights": [1, 2]}', "unknown feature 'neer_vase'"),
        ("a.json", '{"names": ["length"], "weights": [1, 2]}', "1 names, 1 of them different, and 2 weights"),
        ("a.json", '{"names": ["length", "length"], "weights": [1, 2]}', "2 names, 1 of them different"),
        ("a.json", '{"names": ["length"]}', "weights is None"),
        ("a.json", '{"names": ["length"], "weights": ["1"]}', "weight of length is '1'"),
        ("a.json", "{", "not valid JSON"),
        ("a.json", "[1]", "expected an object"),
        ("a.yaml", "length: [1]", r"weight of length is \[1\]"),
        ("a.yaml", "height: 1", "without a weight of length"),
        ("a.yaml", "length: [1", "not YAML"),
    ],
)
def test_a_broken_file_is_refused_in_one_line_that_names_it(tmp_path: Path, name: str, content: str, message: str):
    (tmp_path / name).write_text(content)
    with pytest.raises(UsageError, match=message) as caught:
        Reward.parse(str(tmp_path / name))
    assert str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_environment_keeps_what_is_in_a_file_and_not_where_it_is(tmp_path: Path):
    for name in ("one.yaml", "two.yaml"):
        (tmp_path / name).write_text("length: 1\nheight: 3\n")
    one, two = (make_config(task="carry", reward=str(tmp_path / name)) for name in ("one.yaml", "two.yaml"))
    assert one == two
    assert one.reward == "length=1,height=3"
    assert env_fingerprint(one) == env_fingerprint(two) != env_fingerprint(make_config(task="carry"))
    assert make_config(task="carry", reward="careful") == make_config(task="carry")


def test_tasks_with_one_way_of_doing_it_take_no_reward():
    with pytest.raises(UsageError, match=r"reward is 'length=1.*', but lift has one way of doing it; it is for carry"):
        make_config(task="lift", reward="low")
