"""The cnn policy: keypoints that point, LeRobot's way in and out, and labels and truth that only
training sees.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import NormalizationMode
from lerobot.optim.optimizers import save_optimizer_state
from lerobot.policies.factory import (
    get_policy_class,
    make_policy,
    make_policy_config,
    make_pre_post_processors,
)

from manip_il.data.schema import features
from manip_il.errors import MismatchError, UsageError
from manip_il.learn.cnn import CNNConfig, CNNPolicy, KeypointEncoder
from manip_il.learn.lerobot_config import policy_features
from manip_il.learn.lerobot_policy import build_policy
from manip_il.learn.losses import LOSSES

from .conftest import write_table
from .tiny_policies import edit_config

SIDE = 32
PICTURES = ["observation.images.front", "observation.images.wrist"]
INPUTS = {
    "state": ["observation.state", "observation.environment_state"],
    "images": ["observation.state", *PICTURES],
    "both": ["observation.state", "observation.environment_state", *PICTURES],
}
SMALL = {"channels": (4, 4), "keypoints": 3, "width": 16, "depth": 1, "device": "cpu"}


@pytest.fixture
def table(gapped):
    return gapped


@pytest.fixture
def meta(dataset, spec):
    """What LeRobot knows of a dataset with two cameras, a tenth of whose labels are invalid.

    It has no videos.
    """
    pictured = replace(spec, cameras=("front", "wrist"), image_size=(SIDE, SIDE))
    return SimpleNamespace(features=features(pictured), root=dataset[0].root, stats={})


def new_policy(meta, observation: str = "images", **options) -> CNNPolicy:
    """As LeRobot makes it from a dataset."""
    config = make_policy_config("cnn", **SMALL | options)
    config.input_features, config.output_features = policy_features(
        meta.features, INPUTS[observation]
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = make_policy(config, ds_meta=meta)
    assert isinstance(policy, CNNPolicy)
    policy.train()
    return policy


def make_batch(table, rows: int = 20, seed: int = 0) -> dict[str, torch.Tensor]:
    """The first rows, as LeRobot's preprocessor passes them on, with pictures of noise."""
    generator = torch.Generator().manual_seed(seed)
    batch = {
        key: torch.from_numpy(table[key][:rows])
        for key in ("observation.state", "observation.environment_state", "action")
    }
    for camera in ("front", "wrist"):
        batch[f"observation.images.{camera}"] = torch.rand(rows, 3, SIDE, SIDE, generator=generator)
    return batch | {"index": torch.arange(rows)}


def saved_and_loaded(policy: CNNPolicy, folder: Path, **changes: Any) -> CNNPolicy:
    policy.save_pretrained(folder)
    edit_config(folder, **changes)
    return CNNPolicy.from_pretrained(folder, strict=True).eval()


def rows_of(batch: dict[str, torch.Tensor]) -> list[dict[str, torch.Tensor]]:
    return [
        {key: value[i : i + 1] for key, value in batch.items()} for i in range(len(batch["index"]))
    ]


def test_larger_pictures_are_averaged(meta, table):
    policy, batch = new_policy(meta).eval(), make_batch(table, rows=3)
    larger = batch | {
        key: batch[key].repeat_interleave(3, 2).repeat_interleave(3, 3) for key in PICTURES
    }
    assert torch.allclose(policy.select_action(larger), policy.select_action(batch), atol=1e-5)


def test_a_spot_is_found_between_the_pixels_with_its_size():
    encoder = KeypointEncoder((1, 1), keypoints=1)
    with torch.no_grad():
        for parameter in encoder.parameters():
            parameter.zero_()
        for layer in (encoder.layers[0], encoder.layers[2]):
            assert isinstance(layer, torch.nn.Conv2d)
            layer.weight[0, 0] = 1.0  # sums of the light about a place
        encoder.heat.weight.fill_(0.01)

    def spots(columns: list[float], width: float) -> torch.Tensor:
        down, across = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
        distance = (across - torch.tensor(columns)[:, None, None]).square() + (down - 30.0).square()
        return (0.5 + 0.5 * torch.exp(-distance / width**2)).unsqueeze(1).expand(-1, 3, -1, -1)

    columns = [20.0, 20.5, 21.0, 44.0]
    x, y, spread, strength = encoder(spots(columns, 8.0)).T
    # feature maps are 16 wide, from -1 at pixel 0 to 1 at pixel 60
    torch.testing.assert_close(x, torch.tensor(columns) / 30.0 - 1.0, rtol=0.0, atol=0.006)
    torch.testing.assert_close(y, torch.zeros(4), rtol=0.0, atol=0.006)
    assert encoder(spots([20.0], 11.0))[0, 2] > 1.1 * spread[0]
    nothing = encoder(torch.full((1, 3, 64, 64), 0.5))
    assert nothing[0, 3] < 0.1 * strength.min()


def test_lerobot_makes_it_from_a_dataset_without_a_look_at_the_truth(meta):
    policy = new_policy(meta)
    assert list(policy.config.input_features or {}) == [
        "observation.state", "observation.images.front", "observation.images.wrist"
    ]  # fmt: skip
    # joints, keypoints, and what is read off
    assert policy.model.input_mean.shape == (4 + 2 * 3 * 4 + 6,)
    assert set(CNNConfig(**SMALL).normalization_mapping.values()) == {NormalizationMode.IDENTITY}


@pytest.mark.parametrize("loss", LOSSES)
def test_one_batch_is_learnt_by_heart(loss, meta, table):
    policy = new_policy(meta, loss=loss, width=64, aux_weight=0.0)
    batch = make_batch(table)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-2)
    for _ in range(100):
        value, _ = policy.forward(batch)
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
    valid = torch.from_numpy(table["label_valid"][:20, 0] != 0)
    action = policy.select_action(batch)
    error = (action - batch["action"])[valid, :-1].abs().mean()
    spread = (batch["action"] - batch["observation.state"])[valid, :-1].std(0).mean()
    assert error < 0.35 * spread
    assert policy.predict_action_chunk(batch).shape == (20, 1, 4)
    assert torch.equal(policy.predict_action_chunk(batch)[:, 0], action)


def test_saved_and_loaded_by_lerobot_it_acts_bit_equal(meta, table, tmp_path):
    policy, batch = new_policy(meta), make_batch(table)
    optimizer = torch.optim.AdamW(policy.parameters())
    policy.forward(batch)[0].backward()
    optimizer.step()
    save_optimizer_state(optimizer, tmp_path)  # safetensors takes contiguous tensors only
    policy.save_pretrained(tmp_path / "policy")
    for processor in make_pre_post_processors(policy.config, dataset_stats=meta.stats):
        processor.save_pretrained(tmp_path / "policy")
    again = get_policy_class("cnn").from_pretrained(tmp_path / "policy", strict=True)
    before, after = make_pre_post_processors(again.config, pretrained_path=str(tmp_path / "policy"))
    expected = policy.eval().select_action(batch)
    inputs = {key: batch[key] for key in again.config.input_features or {}}
    for row in range(3):  # unbatched, as a robot gives them
        action = after(
            again.select_action(before({key: value[row] for key, value in inputs.items()}))
        )
        assert torch.equal(action, expected[row : row + 1])


def test_a_row_does_not_depend_on_the_others_nor_on_half_precision(meta, table):
    policy, batch = new_policy(meta).eval(), make_batch(table)
    together = policy.select_action(batch)
    for rows in ([0], [19, 3], list(range(5, 20))):
        assert torch.equal(
            policy.select_action({key: value[rows] for key, value in batch.items()}), together[rows]
        )
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(policy.select_action(batch), together)


def test_the_truth_is_read_off_joints_and_keypoints_and_learnt_while_training_only(meta, table):
    policy, batch = new_policy(meta, aux_weight=0.5), make_batch(table)
    assert new_policy(meta, aux_weight=0.0).privileged is None
    unweighted = new_policy(meta, aux_weight=0.5)
    unweighted.load_state_dict(policy.state_dict())
    unweighted.config.aux_weight = 0.0
    truth = table["observation.environment_state"]
    used = truth[table["label_valid"][:, 0] != -1]
    scaled = (truth[:20] - used.mean(0)) / np.where(used.std(0) < 1e-4, np.inf, used.std(0))
    with torch.no_grad():
        read_off = policy.network_inputs(batch)[:, -6:]
        error = (read_off - torch.from_numpy(scaled)).abs().mean()
    more = policy.forward(batch)[0] - unweighted.forward(batch)[0]
    torch.testing.assert_close(more, (0.5 * error).float(), rtol=1e-3, atol=1e-4)
    held_out = policy.eval().forward(batch)[0]
    assert torch.equal(held_out, unweighted.eval().forward(batch)[0])


def test_offsets_that_are_read_off_or_given_enter_at_several_scales_too(meta, table, tmp_path):
    columns = dict(meta.features)
    names = ["a_from_b.x", "e1", "e2", "a_from_b.z", "e4", "e5"]
    columns["observation.environment_state"] = columns["observation.environment_state"] | {
        "names": names
    }
    named, batch, scales = (
        SimpleNamespace(features=columns, root=meta.root, stats={}),
        make_batch(table),
        (0.003, 0.03),
    )
    truth = torch.from_numpy(table["observation.environment_state"])
    for observation, seen in (("images", 4 + 24), ("both", 4 + 6 + 24)):
        policy = new_policy(named, observation, scales=scales, width=64)
        given = policy.network_inputs(batch)[:, seen:].detach()
        around = truth[:20]
        if observation == "images":
            read_off, given = given[:, :6], given[:, 6:]
            around = read_off * truth.std(0, correction=0) + truth.mean(0)
        squashed = torch.cat([torch.tanh(around[:, [0, 3]] / scale) for scale in scales], dim=1)
        torch.testing.assert_close(given, squashed, rtol=1e-3, atol=1e-3)
        again = saved_and_loaded(policy, tmp_path / observation)
        assert torch.equal(again.select_action(batch), policy.eval().select_action(batch))
    with pytest.raises(UsageError, match="scales needs offsets"):
        new_policy(meta, scales=scales)


def test_with_states_actions_are_learnt_from_true_ones_with_noise_and_follow_the_predicted_one(
    meta, table, spec, tmp_path
):
    policy, batch = new_policy(meta, states=str(meta.root), width=64), make_batch(table)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=3e-3)
    # the label does not show in these
    blank = batch | {key: torch.zeros_like(batch[key]) for key in PICTURES}
    for _ in range(100):
        optimizer.zero_grad()
        policy.forward(blank)[0].backward()
        optimizer.step()
    valid = torch.from_numpy(table["label_valid"][:20, 0] != 0)
    truth = torch.cat([batch["observation.state"], batch["observation.environment_state"]], dim=1)
    assert policy.network_inputs(batch).shape == truth.shape
    error = (policy.model.act(truth) - batch["action"])[valid, :-1].abs().mean()
    assert error < 0.5 * (batch["action"] - batch["observation.state"])[valid, :-1].std(0).mean()
    assert (policy.error > 0).any()
    expected = policy.eval().select_action(batch)
    assert torch.equal(
        expected,
        policy.model.act(torch.cat([policy.network_inputs(row) for row in rows_of(batch)])),
    )
    assert torch.equal(saved_and_loaded(policy, tmp_path).select_action(batch), expected)
    config: Any = policy.config
    wide = write_table({**table, "action": 3 * table["action"]}, tmp_path / "wide", spec)
    config.pretrained_path, config.states = tmp_path, str(wide[0].root)
    again: Any = build_policy(
        config, SimpleNamespace(features=meta.features, root=wide[0].root, stats={})
    )
    assert (again.model.target_high > policy.model.target_high).any(), (
        "it acts within the range of the new data"
    )
    other = write_table(table, tmp_path / "other", replace(spec, task="lift"))
    with pytest.raises(MismatchError, match="task differs"):
        new_policy(meta, states=str(other[0].root))


def test_a_checkpoint_that_learnt_heat_maps_acts_with_all_of_its_keypoints(meta, table, tmp_path):
    policy, batch = new_policy(meta, keypoints=5), make_batch(table)
    old = {"keypoints": 3, "named_points": 2, "heatmap_weight": 0.1}
    again = saved_and_loaded(policy, tmp_path, **old)
    assert torch.equal(again.select_action(batch), policy.eval().select_action(batch))
