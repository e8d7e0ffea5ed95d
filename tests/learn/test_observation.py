"""What a policy sees is chosen by one of three words, the same in training and in a checkpoint."""

from __future__ import annotations

from dataclasses import replace

import pytest
from lerobot.configs import FeatureType

from manip_il.data.schema import features
from manip_il.errors import ManipError, UnknownName
from manip_il.learn.observation import OBSERVATIONS, observation_of, policy_features, recorded_look


@pytest.fixture
def pictured(spec):
    return replace(spec, cameras=("front", "wrist"), image_size=(32, 48))


@pytest.mark.parametrize(
    ("observation", "inputs"),
    [
        ("state", ["observation.state", "observation.environment_state"]),
        ("images", ["observation.state", "observation.images.front", "observation.images.wrist"]),
        (
            "both",
            ["observation.state", "observation.environment_state"]
            + ["observation.images.front", "observation.images.wrist"],
        ),
    ],
)
def test_a_choice_is_its_columns_and_a_checkpoint_tells_it(observation, inputs, pictured):
    seen, given = policy_features(features(pictured), observation)
    assert list(seen) == inputs
    assert list(given) == ["action"]
    assert given["action"].shape == (4,)
    assert observation_of(seen) == observation


def test_pictures_are_channels_first_for_a_policy_and_kinds_are_lerobots(pictured):
    table = features(pictured)
    table["observation.state"] |= {"shape": [4]}  # as JSON has it
    seen, given = policy_features(table, "both")
    assert seen["observation.images.front"].shape == (3, 32, 48)
    assert seen["observation.state"].shape == (4,)
    kinds = [FeatureType.STATE, FeatureType.ENV, FeatureType.VISUAL, FeatureType.VISUAL]
    assert [feature.type for feature in seen.values()] == kinds
    assert given["action"].type is FeatureType.ACTION


def test_what_is_missing_is_named_with_a_way_out(spec, pictured):
    with pytest.raises(UnknownName, match="did you mean 'images'"):
        policy_features(features(spec), "image")
    for observation in ("images", "both"):
        with pytest.raises(ManipError, match=r"no pictures; record with --cameras=front,wrist"):
            policy_features(features(spec), observation)
    table = features(pictured)
    del table["observation.environment_state"]
    assert "observation.environment_state" not in policy_features(table, "images")[0]
    for observation in ("state", "both"):
        with pytest.raises(ManipError, match=r"no observation\.environment_state; .*'images'"):
            policy_features(table, observation)
    del table["action"]
    with pytest.raises(ManipError, match="no action"):
        policy_features(table, "images")


def test_a_policy_of_the_joints_alone_counts_as_state():
    assert observation_of(["observation.state"]) == OBSERVATIONS[0]


def test_a_datasets_light_is_that_of_its_last_rendering_else_the_default():
    made = {"cameras_sha256": "0"}
    look = {"shadows": True, "brightness": 0.5, "light_turn": 0.0}
    assert recorded_look({"rendered": {"cameras": {"names": ["front"], "look": look}}}, made) == look
    assert recorded_look({"driver": "expert"}, made) == {}
    assert recorded_look({}, {}) is None
