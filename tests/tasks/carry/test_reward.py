"""Rewards of `carry`: read from a name, a file or a text, refused in one line, and kept as
numbers.
"""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.checks import task_name
from manip_il.errors import ManipError, UsageError
from manip_il.tasks.carry.layout import FEATURES, Reward
from manip_il.worlds.table import env_fingerprint, env_spec, make_config

numbers = st.floats(0, 1e6, allow_subnormal=False)


@given(st.lists(numbers, min_size=len(FEATURES), max_size=len(FEATURES)))
def test_a_reward_is_read_back_exactly_from_its_numbers(weights: list[float]):
    reward = Reward((max(weights[0], 0.1), *weights[1:]))
    assert Reward.parse(reward.numbers) == reward


def test_an_environment_keeps_what_is_in_a_file_and_not_where_it_is(tmp_path: Path):
    content = {"names": ["height", "length"], "weights": [3.0, 1], "method": "any"}
    for name in ("one.json", "two.json"):
        (tmp_path / name).write_text(json.dumps(content))
    one, two = (make_config(task=f"carry:{tmp_path / name}") for name in ("one.json", "two.json"))
    assert one == two == make_config(task="carry:length=1, height=3")
    assert (one.task, one.name) == ("carry:length=1,height=3", "panda_carry")
    assert env_spec(one).task == one.task
    assert make_config(task="carry:careful") == make_config(task="carry")


@pytest.mark.parametrize(
    ("task", "sha256"), [("carry", "d165c820ba2f39ca"), ("carry:low", "9f48c3c88734fc0d")]
)
def test_a_reward_in_the_name_has_the_fingerprint_that_it_had_as_a_setting(task: str, sha256: str):
    assert env_fingerprint(make_config(task=task))["config_sha256"].startswith(sha256)


def test_a_task_of_which_there_is_one_takes_nothing_behind_a_colon():
    with pytest.raises(UsageError, match=r"task is lift:low, but lift takes no argument"):
        make_config(task="lift:low")
    with pytest.raises(ManipError, match=r"task is 'carry:own.json'; expected NAME=NUMBER"):
        task_name("carry:own.json")
