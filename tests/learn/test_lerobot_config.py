"""Options of LeRobot's, by its names: of policies, optimisers and schedules, and what a policy
sees.
"""

import pytest
from lerobot.optim import AdamWConfig, LRSchedulerConfig, OptimizerConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

from manip_il.errors import UnknownName
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import (
    choice,
    lerobot_options,
    policy_config,
)

from .tiny_policies import write_checkpoint


def configured(settings, **more):
    return policy_config(FitConfig(settings, **more))


def test_options_have_lerobots_names_and_types() -> None:
    config = configured(
        {"type": "diffusion", "down_dims": [32, 64], "horizon": "16", "device": "cpu"}
    )
    assert isinstance(config, DiffusionConfig)
    assert (config.down_dims, config.horizon) == ((32, 64), 16)
    assert config.push_to_hub is False  # LeRobot's default is to upload


def test_optimisers_and_schedules_by_their_type_for_every_policy() -> None:
    adamw = choice(OptimizerConfig, {"type": "adamw", "lr": "5e-4"}, "optimizer")
    assert isinstance(adamw, AdamWConfig)
    assert adamw.lr == 5e-4
    with pytest.raises(UnknownName, match=r"scheduler\.type"):
        choice(LRSchedulerConfig, {"type": "cosine"}, "scheduler")
    for more, rate in (
        ({}, 2e-3),
        ({"lr": 1e-4}, 1e-4),
        ({"optimizer": {"type": "sgd", "lr": 0.1}}, 0.1),
    ):
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
    assert (
        FitConfig({"path": str(write_checkpoint(tmp_path / "mlp", "mlp", spec))}).total_steps
        == 3_000
    )
