"""Options of LeRobot's, by its names: of policies, optimisers and schedules, and what a policy sees."""

from __future__ import annotations

import pytest
import torch
from lerobot.optim import AdamWConfig, LRSchedulerConfig, OptimizerConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import (
    choice,
    lerobot_options,
    option_lines,
    policy_config,
    policy_types,
)

from .tiny_policies import write_checkpoint


def configured(settings, **more):
    return policy_config(FitConfig(settings, **more))


def test_every_policy_of_lerobot_and_ours_is_known() -> None:
    assert {"act", "diffusion", "vqbet", "smolvla", "pi0", "mlp", "cnn"} <= set(policy_types())


def test_options_have_lerobots_names_and_types() -> None:
    config = configured({"type": "diffusion", "down_dims": [32, 64], "horizon": "16", "device": "cpu"})
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
        ({"type": "mlp", "loss": "mes"}, UnknownName, ["'mes'", "mse"]),
        ({"type": "act", "path": "runs/x"}, UsageError, ["--policy.path", "--policy.type"]),
        ({"path": "runs/nothing"}, ManipError, ["runs/nothing", "config.json"]),
        ({"type": "act", "push_to_hub": True}, UnknownName, ["push_to_hub"]),
        ({"type": "act", "device": "cuda"}, UsageError, ["--policy.device=cuda"]),
    ],
)
def test_a_wrong_option_is_one_clear_line(settings, error, words, monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(error) as raised:
        configured(settings)
    text = str(raised.value)
    assert "\n" not in text
    for word in words:
        assert word in text


def test_optimisers_and_schedules_by_their_type_for_every_policy() -> None:
    adamw = choice(OptimizerConfig, {"type": "adamw", "lr": "5e-4"}, "optimizer")
    assert isinstance(adamw, AdamWConfig)
    assert adamw.lr == 5e-4
    with pytest.raises(UnknownName, match=r"scheduler\.type"):
        choice(LRSchedulerConfig, {"type": "cosine"}, "scheduler")
    for more, rate in (({}, 2e-3), ({"lr": 1e-4}, 1e-4), ({"optimizer": {"type": "sgd", "lr": 0.1}}, 0.1)):
        pipeline, _ = lerobot_options(FitConfig(**more))
        assert pipeline.optimizer is not None
        assert pipeline.optimizer.lr == rate


def test_a_checkpoint_gives_its_options_and_they_can_be_changed(spec, tmp_path) -> None:
    path = write_checkpoint(tmp_path, "act", spec, chunk_size=7, n_action_steps=5)
    for changes, sizes in (({}, (7, 5)), ({"n_action_steps": 2}, (7, 2))):
        config = configured({"path": str(path), "device": "cpu"} | changes)
        assert isinstance(config, ACTConfig)
        assert (config.chunk_size, config.n_action_steps) == sizes
        assert config.pretrained_path == path
    started = FitConfig({"path": str(path)})
    assert (started.kind, started.observes, started.total_steps) == ("act", "state", 100_000)
    assert FitConfig({"path": str(write_checkpoint(tmp_path / "mlp", "mlp", spec))}).total_steps == 3_000


def test_the_help_lists_a_policys_options() -> None:
    rows = dict(option_lines("act"))
    assert rows["--policy.chunk_size"] == "100"
    assert rows["--policy.vision_backbone"] == "resnet18"
    assert rows["--policy.temporal_ensemble_coeff"] == "null"
    assert "--policy.push_to_hub" not in rows


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"steps": 0}, "steps is 0; expected at least 1"),
        ({"eval_split": 1.0}, "eval_split is 1.0; expected 0 to 0.99"),
        ({"lr": 0.0}, "lr is 0.0"),
        ({"observation": "images"}, "mlp does not take images"),
    ],
)
def test_options_of_a_fit_out_of_range_are_refused(changes, says):
    with pytest.raises(UsageError, match=says):
        FitConfig(**changes)
