"""Two processes that share every batch learn what one does, within rounding, and leave nothing behind."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from manip_il.cli.main import main
from manip_il.data.dataset import Dataset
from manip_il.errors import ManipError, UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.fit_policy import begin_fit
from manip_il.learn.processes import sharing_batches

from .tiny_policies import ACT


@pytest.fixture(scope="module")
def demos(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("demos") / "d"
    assert main(["record", f"--dataset.root={root}", "--dataset.num_episodes=3", "--workers=1"]) == 0
    return root


def fit(root: Path, folder: Path, processes: int, steps: int = 4) -> dict[str, torch.Tensor]:
    settings = {**ACT, "use_vae": False, "dropout": 0.0}  # nothing that draws
    config = FitConfig(
        settings, steps=steps, batch_size=8, save_freq=2, log_freq=1, eval_split=0.3, processes=processes
    )
    with begin_fit(root, config, folder, spec=Dataset.open(root).spec, resume=folder.is_dir()) as trainer:
        return load_file(trainer.fit() / "model.safetensors")


def val_losses(folder: Path) -> list[float]:
    """Loss on held-out episodes after every step."""
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line)["val_loss"] for line in lines]


@pytest.mark.slow
def test_two_processes_make_the_weights_of_one_within_rounding(demos, tmp_path):
    one, two = fit(demos, tmp_path / "one", 1), fit(demos, tmp_path / "two", 2)
    begun = fit(demos, tmp_path / "begun", 1, steps=1)
    for name, weights in one.items():
        torch.testing.assert_close(two[name], weights, rtol=1e-4, atol=1e-5)
    assert any(not torch.allclose(begun[name], weights, rtol=1e-4, atol=1e-5) for name, weights in one.items())
    assert "RANK" not in os.environ
    losses = [val_losses(tmp_path / name) for name in ("one", "two")]
    assert len(losses[0]) == 4
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)
    again = fit(demos, tmp_path / "again", 1)  # this process is alone again
    assert all(torch.equal(again[name], weights) for name, weights in one.items())


@pytest.mark.slow
def test_a_process_that_dies_is_one_line():
    with pytest.raises(ManipError, match="a process that shares the batches died"):
        _meet_one_that_dies()


def _meet_one_that_dies() -> None:
    with sharing_batches(2, 1, _die):
        torch.distributed.init_process_group("gloo")
        torch.distributed.barrier()


def _die() -> None:
    torch.distributed.init_process_group("gloo")
    os._exit(3)


def test_a_batch_that_cannot_be_shared_is_refused():
    with pytest.raises(UsageError, match=r"batch_size is 9; expected a multiple of processes \(2\)"):
        FitConfig({"type": "act"}, batch_size=9, processes=2)
    with pytest.raises(UsageError, match="processes is 2; the mlp is fitted by one"):
        FitConfig(processes=2)
