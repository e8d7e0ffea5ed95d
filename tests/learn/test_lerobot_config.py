"""Options of LeRobot's, by its names: of policies, optimisers and schedules, and what a policy sees."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.optim import AdamWConfig, LRSchedulerConfig, OptimizerConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

from manip_il.data.schema import features
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.learn.fit_config import NOT_OURS, FitConfig, check_names, policy_files, policy_options
from manip_il.learn.lerobot_config import (
    choice,
    option_lines,
    policy_class,
    policy_config,
    policy_features,
    policy_types,
)
from manip_il.learn.pretrained import observation_of

STATES = ["observation.state", "observation.environment_state"]
PICTURES = ["observation.images.front", "observation.images.wrist"]


def test_every_policy_of_lerobot_and_ours_is_known_also_from_the_text_of_their_files() -> None:
    assert {"act", "diffusion", "vqbet", "smolvla", "pi0", "mlp", "cnn"} <= set(policy_types())
    assert tuple(sorted(policy_files())) == policy_types()


def test_options_have_lerobots_names_and_types() -> None:
    config = policy_config({"type": "diffusion", "down_dims": [32, 64], "horizon": "16", "device": "cpu"})
    assert isinstance(config, DiffusionConfig)
    assert (config.down_dims, config.horizon) == ((32, 64), 16)
    assert config.push_to_hub is False  # LeRobot's default is to upload


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"type": "atc"}, UnknownName, ["'atc'", "did you mean 'act'"]),
        ({"type": "act", "chunksize": 4}, UnknownName, ["'chunksize'", "did you mean 'chunk_size'"]),
        ({"type": "act", "chunk_size": "many"}, UsageError, ["chunk_size", "many"]),
        ({"type": "act", "chunk_size": 4, "n_action_steps": 8}, UsageError, ["8", "4", "n_action_steps"]),
        ({"type": "diffusion", "horizon": 15}, UsageError, ["horizon", "15"]),
        ({"type": "mlp", "loss": "mes"}, UnknownName, ["'mes'", "mse"]),
        ({"type": "act", "path": "runs/x"}, UsageError, ["--policy.path", "--policy.type"]),
        ({"path": "runs/nothing"}, ManipError, ["runs/nothing", "config.json"]),
        ({"type": "act", "push_to_hub": True}, UnknownName, ["push_to_hub"]),
    ],
)
def test_a_wrong_option_is_one_clear_line(settings, error, words) -> None:
    with pytest.raises(error) as raised:
        policy_config(settings)
    text = str(raised.value)
    assert "\n" not in text
    for word in words:
        assert word in text


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a graphics card")
def test_a_card_that_is_not_there_is_named() -> None:
    with pytest.raises(UsageError, match=r"--policy\.device=cuda"):
        policy_config({"type": "act", "device": "cuda"})


def test_optimisers_and_schedules_by_their_type() -> None:
    adamw = choice(OptimizerConfig, {"type": "adamw", "lr": "5e-4"}, "optimizer")
    assert isinstance(adamw, AdamWConfig)
    assert adamw.lr == 5e-4
    with pytest.raises(UnknownName, match=r"scheduler\.type"):
        choice(LRSchedulerConfig, {"type": "cosine"}, "scheduler")


def test_a_checkpoint_gives_its_options_and_they_can_be_changed(tmp_path) -> None:
    policy_config({"type": "act", "chunk_size": 7, "n_action_steps": 5, "device": "cpu"})._save_pretrained(tmp_path)
    (tmp_path / "model.safetensors").touch()
    for changes, sizes in (({}, (7, 5)), ({"n_action_steps": 2}, (7, 2)), ({"chunk_size": 2}, (2, 2))):
        config = policy_config({"path": str(tmp_path), "device": "cpu"} | changes)
        assert isinstance(config, ACTConfig)
        assert (config.chunk_size, config.n_action_steps) == sizes
        assert config.pretrained_path == tmp_path
    longer = policy_config({"type": "act", "chunk_size": 200, "device": "cpu"})
    assert isinstance(longer, ACTConfig)
    assert longer.n_action_steps == 100


def test_the_help_lists_a_policys_options() -> None:
    rows = dict(option_lines("act"))
    assert rows["--policy.chunk_size"] == "100"
    assert "--policy.push_to_hub" not in rows


PLANS = {
    "act": ("chunk_size", 10, 10),
    "diffusion": ("horizon", 16, 15),  # its plan begins with the first of two observations
    "evo1": ("chunk_size", 10, 10),
    "fastwam": ("action_horizon", 8, 8),
    "groot": ("chunk_size", 10, 10),
    "molmoact2": ("chunk_size", 10, 10),
    "multi_task_dit": ("horizon", 16, 15),
    "pi0": ("chunk_size", 10, 10),
    "pi05": ("chunk_size", 10, 10),
    "pi0_fast": ("chunk_size", 10, 10),
    "smolvla": ("chunk_size", 10, 10),
    "tdmpc": ("horizon", 16, 1),
    "vla_jepa": ("chunk_size", 5, 5),
    "wall_x": ("chunk_size", 10, 10),
    "xvla": ("chunk_size", 10, 10),
}


@pytest.mark.parametrize("kind", PLANS)
def test_no_more_actions_are_taken_of_a_plan_than_it_has(kind) -> None:
    option, plan, taken = PLANS[kind]
    config = policy_config({"type": kind, option: plan, "device": "cpu"}, trust=True)
    assert (getattr(config, option), vars(config)["n_action_steps"]) == (plan, taken)


def test_a_policy_that_plans_and_is_not_above_is_new_in_lerobot() -> None:
    plan = {kind for kind in policy_types() if "n_action_steps" in vars(policy_class(kind)).get("__annotations__", {})}
    assert plan == {*PLANS, "eo1"}  # eo1 cannot be made without transformers


def test_packages_that_a_policy_needs_are_named() -> None:
    with pytest.raises(UsageError, match=r"--policy\.type=eo1: 'transformers' is required"):
        policy_config({"type": "eo1", "device": "cpu"}, trust=True)


@pytest.mark.parametrize("kind", policy_files())
def test_a_policys_options_are_the_fields_of_its_class(kind: str):
    wanted = {one.name for one in fields(policy_class(kind)) if one.init and one.name not in NOT_OURS}
    assert set(policy_options(kind)) == wanted


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"steps": 0}, "steps is 0; expected at least 1"),
        ({"num_workers": -1}, "num_workers is -1; expected at least 0"),
        ({"eval_split": 1.0}, "dataset.eval_split is 1.0; expected at least 0 and less than 1"),
        ({"lr": 0.0}, "lr is 0.0; expected more than 0"),
        ({"observation": "images"}, "mlp does not take images"),
        ({"scheduler": {"type": "cosine"}}, "--scheduler is not for --policy.type=mlp"),
    ],
)
def test_options_of_a_fit_out_of_range_or_not_for_the_mlp_are_refused(changes, says):
    with pytest.raises(UsageError, match=says):
        FitConfig(**changes)


def test_a_name_that_is_not_there_is_refused_with_the_nearest():
    with pytest.raises(UnknownName, match=r"unknown policy 'atc' \(did you mean 'act'\?\)"):
        check_names({"type": "atc"})
    with pytest.raises(
        UnknownName, match=r"'chunksize' \(did you mean 'chunk_size'\?\); manip-il train --policy\.type=act"
    ):
        check_names({"type": "act", "chunksize": 3})
    check_names({"type": "act", "chunk_size": 3})
    check_names({"path": "runs/x", "chunk_sice": 3})  # whose type only the checkpoint knows


@pytest.mark.parametrize(
    ("observation", "inputs"),
    [
        ("state", STATES),
        ("images", [STATES[0], *PICTURES]),
        ("both", [*STATES, *PICTURES]),
    ],
)
def test_a_choice_is_its_columns_and_a_checkpoint_tells_it(observation, inputs, pictured):
    observed, acted = policy_features(features(pictured), observation)
    assert list(observed) == inputs
    assert list(acted) == ["action"]
    assert acted["action"].shape == (4,)
    assert observation_of(observed) == observation
    assert observation_of(["observation.state"]) == "state"


def test_pictures_are_channels_first_for_a_policy_and_kinds_are_lerobots(pictured):
    table = features(pictured)
    table["observation.state"] |= {"shape": [4]}  # as JSON has it
    observed, acted = policy_features(table, "both")
    assert observed["observation.images.front"].shape == (3, 32, 48)
    assert observed["observation.state"].shape == (4,)
    kinds = [FeatureType.STATE, FeatureType.ENV, FeatureType.VISUAL, FeatureType.VISUAL]
    assert [feature.type for feature in observed.values()] == kinds
    assert acted["action"].type is FeatureType.ACTION


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
