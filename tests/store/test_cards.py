"""Cards: valid for the Hub, the same every time, and silent about places and secrets."""

from __future__ import annotations

import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import DatasetCard, DatasetCardData, ModelCard, ModelCardData
from PIL import Image

from manip_il.data.dataset import Dataset
from manip_il.errors import ManipError
from manip_il.learn.checkpoint import Origin
from manip_il.store.card_dataset import read_paths
from manip_il.store.cards import CARD, PICTURE, card_for

from ..learn.tiny_policies import write_checkpoint

SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"
URL = "hf://datasets/user/demos"
EVALUATION = {"success_rate": 0.84, "interval": [0.756, 0.899], "confidence": 0.95, "n_episodes": 100}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run with a checkpoint, as `train` leaves it."""
    checkpoints = tmp_path / "run" / "checkpoints"
    write_checkpoint(checkpoints / "004000" / "pretrained_model", "act", Dataset.open(SAMPLE).spec)
    (checkpoints / "last").symlink_to("004000")
    return tmp_path / "run"


def test_the_datasets_card_is_what_the_hub_reads_and_shows_its_picture_by_a_relative_link():
    files = card_for(SAMPLE, "dataset", URL)
    text, picture = files[CARD].decode(), Image.open(io.BytesIO(files[PICTURE]))
    data = DatasetCard(text).data
    assert isinstance(data, DatasetCardData)
    assert (data.license, data.task_categories) == ("apache-2.0", ["robotics"])
    assert {"LeRobot", "robotics", "panda", "pick_place"} <= set(data.to_dict()["tags"])
    assert data.to_dict()["configs"] == [{"config_name": "default", "data_files": "data/*/*.parquet"}]
    for fact in ("| episodes | 10 |", "375 at 20 a second", "10 of 10", "1000000 to 1000009", "model_sha256"):
        assert fact in text
    assert 'LeRobotDataset("user/demos")' in text
    assert f"]({PICTURE})" in text
    assert picture.format == "PNG"
    assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 50


def test_the_drawn_paths_begin_and_end_where_the_cubes_do():
    paths = read_paths(SAMPLE)
    assert len(paths) == 10
    for rows, goal in paths:
        assert np.linalg.norm(rows[-1] - goal) < 0.03  # every sample episode succeeds [m]


def test_the_same_folder_gives_the_same_bytes(tmp_path: Path):
    copy = tmp_path / "copy"
    shutil.copytree(SAMPLE, copy)
    assert card_for(SAMPLE, "dataset", URL) == card_for(copy, "dataset", URL)


def test_a_card_tells_no_place_and_no_secret(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Path):
    monkeypatch.setenv("HF_TOKEN", "hf_SecretOfTheTests")
    copy = tmp_path / "demos"
    shutil.copytree(SAMPLE, copy)
    config = (
        "# manip-il 0.1.0: resolved options (RecordOptions)\nrobot:\n  type: panda\nseed: 3\n"
        "dataset:\n  root: /srv/lab/demos\n  num_episodes: 10\nnote: hf_SecretOfTheTests\napi_key: abcdefgh\n"
    )
    for place in (tmp_path / "demos.journals", run):
        place.mkdir(exist_ok=True)
        (place / "config.yaml").write_text(config.replace("Record", "Train") if place == run else config)
    cards = [card_for(copy, "dataset", f"file://{tmp_path}/x")[CARD], card_for(run, "policy", "hf://user/act")[CARD]]
    for text in (card.decode() for card in cards):
        assert "--robot.type=panda" in text
        assert "--seed=3" in text
        for secret in ("/srv/lab", str(tmp_path), "hf_Secret", "abcdefgh"):
            assert secret not in text
        assert not re.search(r"\]\(/", text)


def test_the_policys_card_is_what_the_hub_reads(run: Path):
    (run / "eval").mkdir()
    (run / "eval" / "eval.json").write_text(json.dumps({**EVALUATION, "robot": "panda", "task": "pick_place"}))
    text = card_for(run, "policy", "hf://user/act")[CARD].decode()
    data = ModelCard(text).data
    assert isinstance(data, ModelCardData)
    assert (data.license, data.library_name, data.pipeline_tag) == ("apache-2.0", "lerobot", "robotics")
    assert data.eval_results[0].metric_value == pytest.approx(0.84)
    assert "**84.0%** [75.6%, 89.9%] (95% interval, 100 episodes), on unseen seeds" in text
    assert "docker run --rm --network=none" in text
    assert "--policy.path=/policy" in text


def test_a_policy_that_nobody_evaluated_says_so(run: Path):
    folder = run / "checkpoints" / "004000" / "pretrained_model"
    text = card_for(folder, "policy", "hf://user/act")[CARD].decode()
    assert "not measured" in text
    assert "model-index" not in ModelCard(text).data.to_dict()
    assert "lerobot-eval --policy.path=user/act" in text
    assert "no human" not in text  # another program's: nobody knows who demonstrated


def test_a_dagger_runs_card_is_of_its_best_policy(tmp_path: Path):
    spec, run = Dataset.open(SAMPLE).spec, tmp_path / "run"
    meta = Origin("panda", "pick_place", 20, ("joint",), ("object.x",), "joint targets [rad]", {}, {})
    write_checkpoint(run / "round_00" / "policy" / "checkpoints" / "000002" / "pretrained_model", "diffusion", spec)
    write_checkpoint(run / "best" / "pretrained_model", "act", spec, origin=meta)
    text = card_for(run, "policy", "hf://user/act")[CARD].decode()
    assert "# act for panda pick_place\n" in text
    assert "--env.task=PandaPickPlace-v0" in text
    assert "manip-il eval --policy.path=runs/act --eval.n_episodes=200\n" in text


def test_a_card_that_somebody_wrote_is_kept_and_one_of_ours_is_made_again(tmp_path: Path):
    copy = tmp_path / "demos"
    shutil.copytree(SAMPLE, copy)
    (copy / CARD).write_text("# My own words\n")
    assert set(card_for(copy, "dataset", URL)) == {PICTURE}
    (copy / CARD).write_bytes(card_for(SAMPLE, "dataset", "hf://datasets/user/old")[CARD])
    assert b"user/demos" in card_for(copy, "dataset", URL)[CARD]


def test_a_folder_without_a_policy_is_refused(tmp_path: Path):
    with pytest.raises(ManipError, match="no policy in"):
        card_for(tmp_path, "policy", "hf://user/act")
