"""The programs that people run, unmodified, around one Hub: ours push and pull, LeRobot's load and train."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from manip_il.cli.main import main
from manip_il.store.cards import CARD, PICTURE

from .hub_server import clean_environment
from .hub_use import SAMPLE, TOKEN, a_hub
from .trees import content

BIN = Path(sys.executable).parent
ACT = (
    *("--policy.type=act", "--policy.dim_model=32", "--policy.n_heads=2", "--policy.dim_feedforward=32"),
    *("--policy.n_encoder_layers=1", "--policy.use_vae=false", "--policy.chunk_size=5", "--policy.n_action_steps=3"),
    *("--policy.device=cpu", "--steps=2", "--batch_size=4", "--num_workers=0"),
)
TRAIN_AND_LOAD = """
from lerobot.scripts.lerobot_train import main

main()

import torch
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.datasets.lerobot_dataset import LeRobotDataset

policy = ACTPolicy.from_pretrained("user/run")
before, after = make_pre_post_processors(policy.config, pretrained_path="user/run")
dataset = LeRobotDataset("user/demos")
action = after(policy.select_action(before(dataset[0])))
print(len(dataset), dataset.num_episodes, dataset.revision, torch.isfinite(action).all())
"""

Program = Callable[..., str]


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Program]:
    """Runs a program of this environment that knows no other Hub than the tests', and gives what it said."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("HF_", "HUGGING"))}

    with a_hub(tmp_path / "hub") as hub:
        environment = kept | clean_environment(hub, tmp_path / "home", TOKEN) | {"OMP_NUM_THREADS": "1"}

        def run(name: str, *words: object) -> str:
            line = [str(BIN / name), *map(str, words)]
            done = subprocess.run(line, check=False, capture_output=True, text=True, env=environment, timeout=300)
            assert done.returncode == 0, done.stderr[-3000:]
            assert TOKEN not in done.stdout + done.stderr
            return done.stdout

        yield run


@pytest.mark.slow
def test_what_is_pushed_is_trained_on_loaded_and_pulled(program: Program, tmp_path: Path):
    run, url = tmp_path / "run", "hf://user/run"
    assert main(["train", f"--dataset.root={SAMPLE}", f"--output_dir={run}", *ACT]) == 0  # which knows of no Hub
    assert "8 files" in program("manip-il", "push", SAMPLE, "hf://datasets/user/demos")
    assert program("manip-il", "push", run, url).startswith(f"{url}: ")
    with ThreadPoolExecutor() as pool:
        words = ["--dataset.repo_id=user/demos", f"--output_dir={tmp_path / 'lerobot'}", "--policy.push_to_hub=false"]
        loaded = pool.submit(program, Path(sys.executable).name, "-c", TRAIN_AND_LOAD, *words, *ACT)
        program("manip-il", "pull", url, tmp_path / "back", "--quiet")
        program("manip-il", "pull", "hf://datasets/user/demos", tmp_path / "demos", "--quiet")
        assert loaded.result().splitlines()[-1] == "375 10 v3.0 tensor(True)"
    assert (tmp_path / "lerobot" / "checkpoints" / "000002" / "pretrained_model" / "model.safetensors").is_file()
    back, demos = content(tmp_path / "back"), content(tmp_path / "demos")
    assert b"lerobot-eval --policy.path=user/run" in back.pop(CARD)
    assert back == content(run)
    assert {path: demos[path] for path in demos if path not in (CARD, PICTURE)} == content(SAMPLE)
