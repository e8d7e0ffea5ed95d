"""Training is a function of table, config and seed; it refuses what it cannot learn from."""

from __future__ import annotations

import json
import math
import os
import stat
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from manip_il import checks
from manip_il.cli.outputs import read_jsonl
from manip_il.errors import FolderExistsError, ManipError, MismatchError, NotFiniteError, UsageError
from manip_il.learn.checkpoint import CheckpointMeta, check_fits, publish, read_meta, recorded_look
from manip_il.learn.columns import learning_rows, split_by_episode
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.losses import LOSSES
from manip_il.learn.metrics import METRICS_FILE, json_lines
from manip_il.learn.mlp import MLPConfig
from manip_il.learn.network import MLPNetwork, fit_statistics
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.train import fit, lr_at


def tiny(policy: dict[str, Any] | None = None, **changes) -> FitConfig:
    values = {"steps": 4, "batch_size": 32, "log_freq": 2, "save_freq": 2, "eval_split": 0.2}
    return FitConfig({"width": 16, "depth": 2, "device": "cpu"} | (policy or {}), **(values | changes))


@pytest.fixture
def train(table, spec, tmp_path):
    """Fit a tiny network to the table in a folder of the test's."""

    def run(config=None, name="", data=table, spec=spec, **options) -> Path:
        return fit(data, config or tiny(), tmp_path / name, spec=spec, **options)

    return run


def equal(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def errors(table, path) -> np.ndarray:
    actions = LearnedPolicy.load(path).act(table["observation.state"], table["observation.environment_state"])
    return np.abs(actions - table["action"]).mean(0)


def test_the_same_seed_gives_the_same_bits_and_the_global_generator_has_no_say(train, weights):
    torch.manual_seed(5)
    before = torch.get_rng_state()
    a, b, c = (weights(train(tiny(seed=seed), name)) for name, seed in (("a", 1), ("b", 1), ("c", 2)))
    assert torch.equal(before, torch.get_rng_state())
    assert equal(a, b)
    assert not equal(a, c)


class KilledError(Exception):
    pass


@pytest.mark.parametrize("loss", LOSSES)
def test_two_steps_and_two_more_are_four(loss, train, tmp_path, weights):
    config = tiny({"loss": loss})
    straight = weights(train(config, "straight"))

    def kill(record):
        if record["step"] == 4:
            raise KilledError

    with pytest.raises(KilledError):
        train(config, "killed", on_log=kill)
    at_two = weights(tmp_path / "killed/checkpoints/last/pretrained_model")
    resumed = weights(train(config, "killed", resume=True))
    assert not equal(at_two, straight)
    assert equal(resumed, straight)
    assert [line["step"] for line in read_jsonl(tmp_path / "killed" / METRICS_FILE)] == [2, 4]


def test_a_finished_run_is_resumed_unchanged_and_neither_overwritten_nor_continued_as_another(
    table, train, tmp_path, weights
):
    before = weights(train())
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == ["000004", "last"]
    assert equal(before, weights(train(resume=True)))
    with pytest.raises(FolderExistsError, match="--resume=true"):
        train()
    with pytest.raises(MismatchError, match="option lr"):
        train(tiny(lr=0.1), resume=True)
    with pytest.raises(MismatchError, match="data"):
        train(data=table | {"action": table["action"] + 0.01}, resume=True)


def test_a_half_written_checkpoint_is_passed_over(train, tmp_path, weights):
    straight = weights(train(name="a"))
    for stale in (".000002.tmp/pretrained_model", "000002/pretrained_model"):
        (tmp_path / "b/checkpoints" / stale).mkdir(parents=True)
    assert equal(straight, weights(train(name="b", resume=True)))


def test_frames_without_a_valid_label_do_not_touch_the_weights(table, train, weights):
    invalid = np.random.default_rng(0).random(len(table["action"])) < 0.3
    table["label_valid"][invalid] = 0
    rubbish = {key: column.copy() for key, column in table.items()}
    rubbish["action"][invalid] = 1e6
    rubbish["observation.environment_state"][invalid] = -1e6
    without = {key: column[~invalid] for key, column in table.items()}
    a, b, c = (weights(train(name=name, data=data)) for name, data in (("a", table), ("b", rubbish), ("c", without)))
    assert equal(a, b)
    assert equal(a, c)


@pytest.mark.parametrize("key", ["observation.state", "observation.environment_state", "action"])
def test_nan_is_refused_with_column_episode_and_frame(key, table, train):
    table[key][47, 1] = np.nan
    with pytest.raises(NotFiniteError, match=rf"{key}, row 47, episode 2, frame 7"):
        train()


def test_a_loss_that_explodes_says_at_which_step(train):
    with pytest.raises(NotFiniteError, match=r"loss is (inf|nan) at step \d"):
        train(tiny(lr=1e30, steps=20))


def test_a_table_that_cannot_be_learnt_from_is_named(table, spec, train):
    with pytest.raises(MismatchError, match=r"observation.environment_state has \(240, 6\).*\(N, 5\)"):
        train(spec=replace(spec, environment_state_names=("x",) * 5))
    with pytest.raises(ManipError, match="none of 240 frames"):
        train(data=table | {"label_valid": np.zeros((240, 1), np.int64)})
    del table["action"]
    with pytest.raises(ManipError, match="no column 'action'"):
        train()


def test_metrics_hold_the_loss_of_whole_held_out_episodes(train):
    records = []
    train(on_log=records.append)
    assert [record["step"] for record in records] == [2, 4]
    assert {"loss", "lr", "samples_per_s", "val_loss", "val_arm_error", "val_gripper_error"} <= records[0].keys()
    episodes = np.repeat(np.arange(12), 20)
    train, held_out = split_by_episode(episodes, 0.2, seed=0)
    assert len(np.unique(episodes[held_out])) == 2
    assert not set(episodes[train]) & set(episodes[held_out])


@pytest.mark.parametrize("loss", LOSSES)
def test_every_loss_learns_to_act(loss, table, train):
    policy = {"loss": loss, "components": 2, "width": 64}
    config = tiny(policy, steps=400, save_freq=400, log_freq=400, batch_size=64, lr=5e-3)
    before = errors(table, train(tiny({"loss": loss}), "before"))
    after = errors(table, train(config, "after"))
    assert after[:-1].mean() < 0.6 * before[:-1].mean()
    assert after[-1] < 0.01


def test_a_warm_start_acts_as_the_policy_it_came_from(table, train, weights):
    first = train(tiny(steps=50), "first")
    wider = {key: column.copy() for key, column in table.items()}
    wider["observation.environment_state"] *= 3.0  # other statistics
    second = train(tiny(steps=1, lr=1e-12, init_from=first), "second", wider)
    a, b = LearnedPolicy.load(first), LearnedPolicy.load(second)
    assert not torch.equal(weights(first)["model.input_scale"], weights(second)["model.input_scale"])
    inputs = table["observation.state"], table["observation.environment_state"]
    np.testing.assert_allclose(a.act(*inputs), b.act(*inputs), atol=2e-5)


def test_a_feature_that_never_moves_is_not_seen(table, train):
    policy = LearnedPolicy.load(train())
    environment = table["observation.environment_state"].copy()
    before = policy.act(table["observation.state"], environment)
    environment[:, 2] += 100.0
    assert np.array_equal(before, policy.act(table["observation.state"], environment))


def test_statistics_undo_themselves_and_take_constant_targets(table):
    rows = learning_rows(table)
    targets = rows.targets.copy()
    targets[:, 1] = 0.5
    for loss in ("mse", "categorical"):
        s = fit_statistics(rows.inputs, targets, loss)
        network = MLPNetwork(rows.inputs.shape[1], targets.shape[1], MLPConfig(loss=loss).network_shape())
        network.set_statistics(s)
        y = network.encode_targets(torch.from_numpy(targets))
        assert torch.isfinite(y).all()
        np.testing.assert_allclose(y * s.target_scale + s.target_mean, targets, atol=1e-6)
    assert y.abs().max() <= 1 + 1e-5


def test_the_learning_rate_warms_up_and_goes_to_zero():
    rates = [lr_at(step, 1000, 1.0) for step in range(1000)]
    assert rates[:100] == sorted(rates[:100])
    assert rates[100] == 1.0
    assert rates[100:] == sorted(rates[100:], reverse=True)
    assert rates[-1] < 1e-5


def test_the_meta_says_what_the_policy_is_for(spec, train):
    meta = read_meta(train(fingerprint={"mujoco": "3.11"}))
    assert meta is not None
    assert meta == replace(
        CheckpointMeta.of(spec, {"mujoco": "3.11"}, action_space="joint_delta"), options=meta.options
    )
    assert meta.options["policy"]["width"] == 16
    check_fits(meta, spec)


@pytest.mark.parametrize(
    "change",
    [
        {"robot": "leg"},
        {"fps": 50},
        {"joint_names": ("a", "c", "b", "gripper")},
        {"environment_state_names": ("x",)},
        {"action_meaning": "torques"},
    ],
)
def test_a_policy_for_something_else_is_refused_naming_both(change, spec):
    meta = CheckpointMeta.of(spec)
    with pytest.raises(MismatchError) as error:
        check_fits(meta, replace(spec, **change))
    ((name, value),) = change.items()
    assert str(value) in str(error.value)
    assert str(getattr(spec, name)) in str(error.value)


def test_a_checkpoint_is_readable_for_whom_the_umask_lets_read(tmp_path):
    before = os.umask(0o027)
    try:
        made = tmp_path / "made"
        made.mkdir()
        (made / "model.safetensors").touch(mode=0o600)
        publish(made, tmp_path / "000002")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "last" / "model.safetensors").stat().st_mode) == 0o640


def test_curves_for_tensorboard_and_weights_and_biases(train, tmp_path, curves):
    config = FitConfig(steps=4, batch_size=8, log_freq=1)
    path, plain = train(replace(config, **curves.options), "r"), train(config, "plain")
    assert curves.steps(tmp_path / "r") == [1, 2, 3, 4]
    for name in ("model.safetensors", "manip_il.json"):
        assert (path / name).read_bytes() == (plain / name).read_bytes()


@pytest.mark.parametrize(
    ("module", "options", "words"),
    [
        ("torch.utils.tensorboard", {"tensorboard": True}, r"manip_il\[tensorboard\]"),
        ("wandb", {"wandb": {"enable": True}}, "pip install wandb"),
    ],
)
def test_a_logger_that_is_not_installed_is_named(module, options, words, train, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=words):
        train(FitConfig(steps=1, batch_size=8, **options))


@pytest.mark.parametrize("content", [b"", b"\xff" * 100, b"\x02\0\0\0\0\0\0\0[]"])
def test_a_warm_start_from_weights_that_cannot_be_read_names_them(train, tmp_path, content):
    (tmp_path / "model.safetensors").write_bytes(content)
    with pytest.raises(ManipError, match=f"cannot read {tmp_path}/model.safetensors to start from its weights: "):
        train(tiny(steps=1, init_from=tmp_path), "run")


def test_a_datasets_light_is_that_of_its_last_rendering_else_the_default():
    made = {"cameras_sha256": "0"}
    look = {"shadows": True, "brightness": 0.5, "light_turn": 0.0}
    assert recorded_look({"rendered": {"cameras": {"names": ["front"], "look": look}}}, made) == look
    assert recorded_look({"driver": "expert"}, made) == {}
    assert recorded_look({}, {}) is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_null_also_in_lines_of_earlier_versions(tmp_path: Path, value: float) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps({"step": step, "grad_norm": math.nan}) + "\n" for step in (1, 2, 3)))
    with json_lines(path, 2) as write:
        write({"step": 3, "loss": 0.5, "grad_norm": value})
    expected = {"step": 3, "loss": 0.5, "grad_norm": None}
    assert read_jsonl(path) == [{"step": 1, "grad_norm": None}, {"step": 2, "grad_norm": None}, expected]
    assert checks.parse_json("a line", path.read_bytes().splitlines()[-1]) == expected
