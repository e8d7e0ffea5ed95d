"""LeRobot's own tools make, train, load and run the mlp policy."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors

from manip_il.errors import MismatchError
from manip_il.learn.mlp.modeling_mlp import MLPPolicy
from manip_il.learn.policy import LearnedPolicy


def test_make_policy_takes_features_and_the_statistics_of_the_valid_relative_targets(dataset, gapped, tmp_path):
    policy = make_policy(make_policy_config("mlp"), ds_meta=dataset.meta)
    assert isinstance(policy, MLPPolicy)
    valid = gapped["label_valid"][:, 0] != 0
    relative = (gapped["action"][:, :-1] - gapped["observation.state"][:, :-1])[valid]
    np.testing.assert_allclose(policy.model.target_mean[:-1], relative.mean(0), atol=1e-6)
    np.testing.assert_allclose(policy.model.target_scale[:-1], relative.std(0), rtol=1e-4)
    assert sorted(policy.config.input_features) == ["observation.environment_state", "observation.state"]
    policy.save_pretrained(tmp_path / "policy")
    config = PreTrainedConfig.from_pretrained(tmp_path / "policy")
    assert config.input_features["observation.environment_state"].type is FeatureType.ENV
    assert config.output_features["action"].shape == (4,)


def test_lerobots_batches_leave_out_frames_without_a_valid_label(dataset):
    policy = make_policy(make_policy_config("mlp"), ds_meta=dataset.meta)
    assert isinstance(policy, MLPPolicy)
    before, _ = make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)
    batch = before(next(iter(torch.utils.data.DataLoader(dataset, batch_size=20))))
    assert "label_valid" not in batch  # LeRobot drops it: frames are known by their index
    each, _ = policy.forward(batch, reduction="none")
    assert [i for i in range(20) if each[i] == 0] == [0, 10]
    mean, _ = policy.forward(batch)
    torch.testing.assert_close(mean, each.sum() / 18)


def test_features_that_do_not_fit_are_refused(dataset):
    columns = dict(dataset.meta.features)
    columns["action"] = columns["action"] | {"shape": (3,)}
    with pytest.raises(MismatchError, match=r"\(4,\).*\(3,\)"):
        make_policy(make_policy_config("mlp"), ds_meta=SimpleNamespace(features=columns, root=dataset.root, stats={}))


@pytest.mark.slow
def test_a_run_of_lerobot_train_is_resumed_by_it(warm_lerobot, dataset, tmp_path):
    def lerobot_train(*options: str) -> None:
        run = warm_lerobot.run("lerobot-train", *options, "--policy.discover_packages_path=manip_il.learn.mlp")
        assert run.returncode == 0, run.stderr[-3000:]

    lerobot_train(
        "--policy.type=mlp", "--policy.width=64", "--policy.scheduler_warmup_steps=10", "--dataset.repo_id=manip/test",
        f"--dataset.root={dataset.root}", f"--output_dir={tmp_path / 'run'}", "--steps=20", "--save_freq=10",
        "--batch_size=32", "--num_workers=0", "--prefetch_factor=null", "--persistent_workers=false",
        "--wandb.enable=false",
    )  # fmt: skip
    checkpoints = tmp_path / "run/checkpoints"
    config = checkpoints / "000010/pretrained_model/train_config.json"
    assert json.loads(config.read_text())["policy"]["type"] == "mlp"
    lerobot_train(f"--config_path={config}", "--resume=true", "--steps=11")
    for step in ("000011", "last"):
        assert LearnedPolicy.load(checkpoints / step / "pretrained_model").interface.type == "mlp"
