"""Samples are windows of one episode, of one dataset or of several."""

import json
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from manip_il.data.dataset import Dataset, JoinedDatasets
from manip_il.learn.batches import to_float
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.samples import Windows
from manip_il.learn.train import Trainer

from .conftest import make_table, write_table
from .tiny_policies import ACT, DIFFUSION

EPISODES = np.repeat([0, 1, 2], [5, 2, 4])


@given(
    st.lists(st.integers(1, 6), min_size=1, max_size=5),
    st.lists(st.integers(-4, 4), min_size=1, max_size=6),
)
def test_a_window_never_leaves_its_episode(lengths, deltas) -> None:
    episodes = np.repeat(np.arange(len(lengths)), lengths)
    samples = np.arange(len(episodes))
    rows, padding = Windows(episodes, {"action": np.array(deltas)}).rows(samples, "action")
    padded = padding["action_is_pad"].numpy()
    assert (episodes[rows] == episodes[:, None]).all()
    wanted = samples[:, None] + np.array(deltas)
    assert (rows[~padded] == wanted[~padded]).all()
    around = np.pad(episodes, 4, constant_values=-1)  # of what lies beyond all episodes
    assert (padded == (around[wanted + 4] != episodes[:, None])).all()


@pytest.mark.parametrize(
    ("deltas", "invalid", "drop_last", "usable"),
    [
        # 1, 2 and 3 would learn from frame 3
        ({"action": np.arange(3)}, [3], 0, [0, 4, 5, 6, 7, 8, 9, 10]),
        ({}, [], 1, [0, 1, 2, 3, 5, 7, 8, 9]),
    ],
    ids=["unsound label", "last frames"],
)
def test_samples_with_an_unsound_label_and_last_frames_are_left_out(
    deltas, invalid, drop_last, usable
) -> None:
    valid = ~np.isin(np.arange(11), invalid)
    assert Windows(EPISODES, deltas).usable(valid, drop_last).tolist() == usable


@pytest.mark.parametrize(
    ("settings", "observation"),
    [(ACT, "state"), (DIFFUSION, "state"), (ACT, "images"), (ACT, "both")],
    ids=lambda value: str(value["type"] if isinstance(value, dict) else value),
)
def test_a_batch_is_that_of_lerobots_loader(
    settings, observation, write, table, pictured, tmp_path
):
    sources = write(table, spec=pictured)
    config = FitConfig(
        {**settings, "pretrained_backbone_weights": None}, observation=observation, batch_size=8
    )
    trainer = Trainer(sources, config, tmp_path / "run")
    samples, meta = trainer.data, JoinedDatasets(sources)
    ahead = resolve_delta_timestamps(trainer.pipeline.policy, cast(Any, meta))
    lerobots: Any = LeRobotDataset(meta.repo_id, root=sources[0].root, delta_timestamps=ahead)
    for rows in (np.array([0, 3, 20, sum(map(len, sources)) - 1]), np.array([7])):
        theirs = torch.utils.data.default_collate([lerobots[int(row)] for row in rows])
        batch = samples.batch(rows)
        assert {f"{key}_is_pad" for key in batch if key in (ahead or {})} <= batch.keys()
        for key, value in batch.items():
            if key == "task":
                assert list(value) == list(theirs[key])
                continue
            other = theirs[key].to(torch.float64).reshape(value.shape)
            value = to_float(value) if value.dtype == torch.uint8 else value
            torch.testing.assert_close(value.to(torch.float64), other, rtol=0, atol=1e-7)


def test_tasks_of_several_datasets_are_numbered_together(spec, tmp_path):
    texts = [replace(spec, instruction=text) for text in ("reach", "touch")]
    made = [write_table(make_table(), tmp_path / one.instruction, one)[0] for one in texts]
    samples = Trainer(made, FitConfig(ACT, batch_size=8), tmp_path / "run").data
    batch = samples.batch(np.array([0, 239, 240, 479]))
    assert batch["task"] == ["reach", "reach", "touch", "touch"]
    assert batch["index"].tolist() == [0, 239, 240, 479]
    assert batch["episode_index"].tolist() == [0, 11, 12, 23]


def test_unlabelled_frames_count_in_no_dataset_that_says_so(spec, tmp_path):
    table, other = make_table(), make_table()
    table["label_valid"][:100] = 0
    sources = [
        *write_table(table, tmp_path / "half", spec),
        *write_table(other, tmp_path / "whole", spec),
    ]
    info = tmp_path / "whole" / "meta" / "info.json"
    told = json.loads(info.read_text())
    del told["features"]["label_valid"]
    info.write_text(json.dumps(told))
    made = [sources[0], Dataset.open(tmp_path / "whole")]
    data = Trainer(made, FitConfig(steps=2, batch_size=8), tmp_path / "run").data
    assert len(data.train) + len(data.held_out) == 140 + 240


def test_an_environment_state_of_one_number_is_a_vector(spec, tmp_path):
    one = replace(spec, environment_state_names=("e0",))
    table = make_table()
    table["observation.environment_state"] = table["observation.environment_state"][:, :1]
    trainer = Trainer(
        write_table(table, tmp_path / "data", one),
        FitConfig(steps=2, batch_size=8),
        tmp_path / "run",
    )
    assert trainer.data.columns["observation.environment_state"].shape == (240, 1)
    trainer.fit()
