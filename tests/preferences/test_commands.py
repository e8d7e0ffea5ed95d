"""The commands: from datasets to a reward, scores and a weighted clone; bad input is one line."""

import json
from pathlib import Path

import pytest

from manip_il.cli.main import main

SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"


@pytest.fixture
def here(tmp_path, monkeypatch, datasets):
    monkeypatch.chdir(tmp_path)
    for name in ("good", "bad", "other"):
        (tmp_path / name).symlink_to(datasets / name)
    return tmp_path


def run(line: str) -> int:
    return main([*line.split(), "--quiet"])


def test_a_reward_is_learnt_and_weighs_the_frames_of_a_clone(here, capsys):
    assert run("reward pairs good bad --clip=10 --count=40") == 0
    assert (
        run("reward answer pairs.json --sources=good,bad --teacher=mistaken:0.1 --output=a.json")
        == 0
    )
    assert run("reward answer pairs.json --sources=good,bad --teacher=perfect --output=b.json") == 0
    assert (
        run(
            "reward fit pairs.json a.json b.json --sources=good,bad --members=3 --output_dir=reward"
        )
        == 0
    )
    assert "80 answers about 40 pairs" in capsys.readouterr().out
    found = json.loads((here / "reward" / "fit.json").read_text())
    assert 60 <= found["agreement_with_answers"]["of"] <= 80
    assert run("data score bad --reward=reward --output_dir=scores") == 0
    words = (
        "--dataset.root=bad --weights=scores/rabc.parquet --steps=2 --batch_size=8 --policy.width=8"
    )
    assert run(f"train {words} --output_dir=weighted") == 0
    capsys.readouterr()
    assert (here / "weighted/checkpoints/last/pretrained_model/model.safetensors").is_file()
    assert run("reward pairs good bad --clip=10 --count=5 --output=more.json") == 0
    assert run("reward answer more.json --sources=good,bad --output=c.json") == 0
    assert (
        run("reward fit pairs.json c.json --sources=good,bad --members=3 --output_dir=third") == 1
    )
    assert "sha256 of the pairs differs: c.json has" in capsys.readouterr().err


def test_true_progress_scores_without_a_reward(here, capsys):
    assert run("data score good --reward=progress --output_dir=scores") == 0
    assert len(json.loads((here / "scores/scores.json").read_text())["episodes"]) == 8
    assert {path.name for path in (here / "scores").iterdir()} == {
        "config.yaml",
        "rabc.parquet",
        "scores.json",
    }
