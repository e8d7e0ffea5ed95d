"""With too little memory for its numbers a fit keeps them in files, and comes to the same bits."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.data import arrays
from manip_il.data.arrays import on_disk
from manip_il.data.dataset import joined_columns
from manip_il.data.schema import ACTION
from manip_il.errors import ManipError, UsageError
from manip_il.learn import room as rooms
from manip_il.learn.columns import LEARNING_COLUMNS
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.fit_policy import PolicyTrainer
from manip_il.learn.network import fit_statistics
from manip_il.learn.room import room
from manip_il.learn.train import fit

ACT = {"type": "act", "chunk_size": 4, "n_action_steps": 2, "dim_model": 16, "n_heads": 2, "dim_feedforward": 16}
SMALL = {"n_encoder_layers": 1, "n_decoder_layers": 1, "use_vae": False, "device": "cpu"}
A_BATCH = 32 * 4 * 14 / 1e9  # of the mlp [GB]: 14 numbers a frame


def tiny(policy: dict[str, Any], **changes: Any) -> FitConfig:
    return FitConfig(policy, steps=4, batch_size=32, log_freq=2, save_freq=2, eval_split=0.2, **changes)


def mlp(**changes: Any) -> FitConfig:
    return tiny({"width": 16, "depth": 2, "device": "cpu"}, **changes)


@pytest.fixture
def in_files(monkeypatch) -> list[int]:
    """Sizes of the arrays that were kept in files; everything goes piece by piece, three rows each."""
    monkeypatch.setattr(arrays, "_ROWS", 3)
    sizes: list[int] = []

    def counting(folder: Path) -> arrays.Allocate:
        allocate = on_disk(folder)

        def counted(*what: Any) -> Any:
            made = allocate(*what)
            assert isinstance(made, np.memmap)
            sizes.append(made.nbytes)
            return made

        return counted

    monkeypatch.setattr(rooms, "on_disk", counting)
    return sizes


def test_an_mlp_is_the_same_from_files(table, spec, tmp_path, in_files):
    names = ("memory", "files")
    for name, memory in zip(names, (None, A_BATCH), strict=True):
        assert not in_files
        fit(table, mlp(memory=memory), tmp_path / name, spec=spec)
    assert sum(in_files) > len(table[ACTION]) * 14 * 4
    model = "checkpoints/last/pretrained_model/model.safetensors"
    one, other = ((tmp_path / name / model).read_bytes() for name in names)
    assert one == other
    assert sorted(path.name for path in (tmp_path / "files").iterdir()) == ["checkpoints", "metrics.jsonl"]


def test_a_policy_of_lerobots_is_the_same_from_files(dataset, spec, tmp_path, in_files):
    for name, memory in (("memory", None), ("files", 1e-5)):
        assert not in_files
        PolicyTrainer(dataset.root, tiny(ACT | SMALL, memory=memory), tmp_path / name, spec=spec).fit()
    assert in_files
    model = "checkpoints/last/pretrained_model/model.safetensors"
    assert (tmp_path / "memory" / model).read_bytes() == (tmp_path / "files" / model).read_bytes()


def test_columns_are_the_same_in_files(dataset, tmp_path):
    tables = [joined_columns([dataset.root] * 2, LEARNING_COLUMNS, *how) for how in ((), (on_disk(tmp_path),))]
    for key, column in tables[0].items():
        assert np.array_equal(column, tables[1][key])
        assert column.dtype == tables[1][key].dtype
        assert isinstance(tables[1][key], np.memmap)
    assert not any(tmp_path.iterdir())


def test_less_memory_than_a_batch_needs_is_refused(table, spec, tmp_path):
    with pytest.raises(UsageError, match=r"a batch of 32 samples takes 1.8e-06 GB: give more, or a smaller"):
        fit(table, mlp(memory=0.99 * A_BATCH), tmp_path, spec=spec)
    with pytest.raises(UsageError, match="memory is 0 GB; expected more than 0"):
        mlp(memory=0)


def test_what_fits_stays_in_memory(tmp_path):
    size = 3 * 4 * 14 * 1_000 / 1e9
    assert room(mlp(memory=size), tmp_path, 1_000, 14) is arrays.in_memory
    assert room(mlp(memory=0.99 * size), tmp_path, 1_000, 14) is not arrays.in_memory


def test_a_full_disk_is_one_line(tmp_path, monkeypatch):
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(ManipError, match=r"cannot keep 4\.0 GB in .*: No space left on device; make room there"):
        on_disk(tmp_path)((1_000_000_000,), np.float32)


@pytest.mark.parametrize("loss", ["mse", "categorical"])
def test_statistics_by_pieces_are_those_of_the_whole(table, monkeypatch, loss):
    inputs, targets = np.concatenate([table["observation.state"], table[ACTION]], axis=1), table[ACTION]
    rows = np.arange(0, len(inputs), 2)
    whole = fit_statistics(inputs[rows], targets[rows], loss)
    monkeypatch.setattr(arrays, "_ROWS", 7)
    for name, values in vars(fit_statistics(inputs, targets, loss, rows)).items():
        np.testing.assert_allclose(values, getattr(whole, name), rtol=1e-6)
    np.testing.assert_allclose(whole.input_mean, inputs[rows].mean(0, dtype=np.float64), rtol=1e-6)
    np.testing.assert_allclose(1 / whole.input_scale, inputs[rows].std(0, dtype=np.float64), rtol=1e-6)
