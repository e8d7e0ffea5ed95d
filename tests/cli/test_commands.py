"""Recording, training, DAgger and the demo from the command line."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import MISSING
from pathlib import Path

import numpy as np
import pytest

from manip_il.cli.main import load, main
from manip_il.cli.parsing import from_yaml, options_of, parse
from manip_il.data.atomic import read_lines
from manip_il.data.dataset import Dataset
from manip_il.evaluation.results import EvalResult

from .made_runs import files

ROOT = Path(__file__).resolve().parents[2]
TINY_DAGGER = [
    "--demonstrations=3",
    "--rounds=1",
    "--episodes_per_round=2",
    "--steps=20",
    "--policy.width=16",
    "--validation_episodes=2",
    "--env.horizon=60",
    "--workers=1",
]


def record(root: Path, episodes: int, *words: str) -> list[str]:
    return [
        *f"record --dataset.root={root} --dataset.num_episodes={episodes} --workers=1".split(),
        *words,
    ]


@pytest.fixture(scope="module")
def demos(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("demos") / "d"
    assert main(record(root, 3)) == 0
    return root


@pytest.fixture(scope="module")
def policy(demos, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "t"
    words = (
        f"train --dataset.root={demos} --steps=20 --policy.width=16 --output_dir={folder}"
    ).split()
    assert main(words) == 0
    return folder


@pytest.mark.parametrize(
    "path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda path: path.stem
)
def test_a_config_loads_by_the_command_in_its_first_line(path):
    command = path.read_text().splitlines()[0].removeprefix("# ").split()
    assert command[0] == "manip-il"
    assert command[2] == f"--config_path=configs/{path.name}"
    kind = load(command[1])
    needed = [f"{option.label}=x" for option in options_of(kind) if option.default is MISSING]
    assert from_yaml(path, kind) != parse(kind, needed)


def test_record_writes_successes_and_their_provenance(demos):
    dataset = Dataset.open(demos)
    assert (dataset.info.episodes, dataset.count_successes()) == (3, 3)
    assert (dataset.spec.robot, dataset.spec.task) == ("panda", "pick_place")
    table = Dataset.open(demos).columns(["seed", "actor", "label_valid"])
    assert np.unique(table["seed"]).tolist() == [1_000_000, 1_000_001, 1_000_002]
    assert not table["actor"].any()
    assert table["label_valid"].all()
    assert Dataset.open(demos).provenance["seeds"] == [1_000_000, 1_000_002]


def test_record_goes_on_to_more_episodes_as_if_asked_for_them_at_once(demos, tmp_path, error):
    assert main(record(tmp_path / "d", 2)) == 0
    assert main(record(tmp_path / "d", 3, "--resume=true")) == 0
    assert files(tmp_path / "d") == files(demos)
    assert main(record(tmp_path / "d", 3, "--resume=true", "--seed=1")) == 1
    assert "--seed differs" in error()


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_done_and_says_how_to_go_on(tmp_path):
    words = [sys.executable, "-m", "manip_il.cli.main", *record(tmp_path / "d", 1_000)]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not list((tmp_path / "d.journals").glob("episode-*")):
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGINT)
    err = process.communicate(timeout=600)[1]
    assert process.returncode == 130
    assert "kept: every finished episode" in err
    assert err.rstrip().endswith("continue with --resume=true")


def test_train_to_eval(policy, tmp_path, capsys, error):
    words = f"eval --policy.path={policy} --eval.n_episodes=2 --workers=1 --eval.films=0".split()
    words += [f"--output_dir={tmp_path / 'e'}"]
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert "differs" not in err
    assert "--replay=4000000" in out
    result = EvalResult.read(tmp_path / "e" / "eval.json")
    assert [episode.seed for episode in result.episodes] == [4_000_000, 4_000_001]
    assert (result.robot, result.task, result.settings.disturbance) == (
        "panda",
        "pick_place",
        "none",
    )
    assert main([*words, "--overwrite=true", "--env.tolerance=0.05", "--suite=knocked"]) == 0
    assert "config_sha256 differs" in capsys.readouterr().err
    assert "noise" in EvalResult.read(tmp_path / "e").settings.disturbance
    assert main([*words, "--overwrite=true", "--robot.type=fetch"]) == 1
    assert "robot differs: the policy has panda" in error()


@pytest.mark.slow
def test_a_dagger_run_may_have_more_rounds_and_no_other_options(tmp_path, error):
    run = tmp_path / "run"
    words = ["dagger", *TINY_DAGGER, f"--output_dir={run}"]
    assert main(words) == 0
    for name in (
        "config.yaml",
        "fingerprint.json",
        "report.html",
        "best/pretrained_model/model.safetensors",
    ):
        assert (run / name).is_file()
    assert main([*words, "--resume=true", "--beta=constant:0.5"]) == 1
    assert "--beta differs" in error()
    assert main([*words, "--resume=true", "--rounds=2"]) == 0
    assert [record["round"] for record in read_lines(run / "metrics.jsonl")] == [0, 1, 2]
    assert Dataset.open(run / "dataset").info.episodes == 3 + 2 * 2
