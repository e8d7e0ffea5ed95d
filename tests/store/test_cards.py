"""Cards: valid for the Hub, the same every time, silent about places and secrets, and honest
about who made what.
"""

import json
import shutil
from pathlib import Path

import pytest
from huggingface_hub import DatasetCard, ModelCard

from manip_il.bridges.store.hub import write_cards
from manip_il.data.dataset import Dataset
from manip_il.data.fingerprint import policy_sha256
from manip_il.data.lerobot_layout import OURS
from manip_il.errors import ManipError
from manip_il.learn.checkpoint import Origin

from ..damage import edit_json
from ..learn.tiny_policies import write_checkpoint
from .conftest import SAMPLE

CARD = "README.md"
EVALUATION = {
    "success_rate": 0.84,
    "interval": [0.756, 0.899],
    "confidence": 0.95,
    "n_episodes": 100,
}


def cards(root: Path, kind: str = "dataset", place: str = "user/demos") -> dict[str, bytes]:
    made = root.parent / "made"
    made.mkdir(exist_ok=True)
    return {name: path.read_bytes() for name, path in write_cards(root, kind, place, made).items()}


@pytest.fixture
def demos(tmp_path: Path) -> Path:
    return shutil.copytree(SAMPLE, tmp_path / "demos")


def test_a_datasets_card_says_what_the_hub_reads_and_claims_nothing_of_what_others_made(
    demos: Path, tmp_path: Path
):
    files = cards(demos)
    text, data = files[CARD].decode(), DatasetCard(files[CARD].decode()).data.to_dict()
    assert (data["license"], data["task_categories"]) == ("apache-2.0", ["robotics"])
    assert {"LeRobot", "robotics", "manip_il", "panda", "pick_place"} == set(data["tags"])
    for fact in (
        "| episodes | 10 |",
        "375 at 20 a second",
        "10 of 10",
        "1000000 to 1000009",
        "model_sha256",
    ):
        assert fact in text
    assert 'LeRobotDataset("user/demos")' in text
    assert cards(shutil.copytree(SAMPLE, tmp_path / "again")) == files
    (demos / "meta" / "manip_il.json").unlink()
    text = cards(demos)[CARD].decode()
    data = DatasetCard(text).data.to_dict()
    assert "license" not in data
    assert "manip_il" not in data["tags"]
    assert "made by" not in text


def test_a_card_that_somebody_wrote_is_kept_and_one_of_ours_is_made_again(demos: Path):
    (demos / CARD).write_text("# My own words\n")
    assert not cards(demos)
    (demos / CARD).unlink()
    (demos / CARD).write_bytes(cards(demos, place="user/old")[CARD])
    assert b"user/demos" in cards(demos)[CARD]


def test_a_card_tells_no_secret(demos: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HF_TOKEN", "HeardInTheTests")
    edit_json(demos / OURS, lambda ours: ours.update(provenance={"driver": "HeardInTheTests"}))
    text = cards(demos)[CARD].decode()
    assert "[hidden] drove" in text
    assert "HeardInTheTests" not in text


def test_a_value_stays_on_its_line_of_a_command(tmp_path: Path):
    meta, root = (
        Origin("panda", "pick_place", 20, ("joint",), ("object.x",), "", {}, {}),
        tmp_path / "policy",
    )
    write_checkpoint(root, "act", Dataset.open(SAMPLE).spec, origin=meta)
    fences = cards(root, "policy", "user/act")[CARD].count(b"\n```")
    about, evil = json.loads((root / "manip_il.json").read_text()), "x\nrm -rf ~\n```\r$(rm -rf ~)"
    values = {
        "object": evil,
        "task": f"pick_place:{evil}",
        "cameras": [evil],
        "image_size": [evil, 1],
        "fps": evil,
    }
    (root / "manip_il.json").write_text(json.dumps(about | values))
    text = cards(root, "policy", "user/act")[CARD].decode()
    assert not [line for line in text.splitlines() if line.lstrip().startswith(("rm -rf", "$"))]
    assert text.count("\n```") == fences
    assert "--env.object='x rm -rf ~ ``` $(rm -rf ~)'" in text


def test_a_policys_card_is_of_its_best_policy_and_says_how_well_it_does(tmp_path: Path):
    spec, run = Dataset.open(SAMPLE).spec, tmp_path / "run"
    meta = Origin(
        "panda", "pick_place", 20, ("joint",), ("object.x",), "joint targets [rad]", {}, {}
    )
    write_checkpoint(
        run / "round_00" / "policy" / "checkpoints" / "000002" / "pretrained_model",
        "diffusion",
        spec,
    )
    write_checkpoint(run / "best" / "pretrained_model", "act", spec, origin=meta)
    assert "not measured" in cards(run, "policy", "user/act")[CARD].decode()
    better = EVALUATION | {"success_rate": 0.97, "n_episodes": 500}
    others = {
        "easy": better | {"settings": {"suite": "easy"}},
        "other": better | {"policy_sha256": "another"},
    }
    own = EVALUATION | {"policy_sha256": policy_sha256(run / "best" / "pretrained_model")}
    for place, more in {"eval": {}, "validation/3": better, "round_1": better, **others}.items():
        (run / place).mkdir(parents=True)
        (run / place / "eval.json").write_text(json.dumps(own | more))
    text = cards(run, "policy", "user/act")[CARD].decode()
    data = ModelCard(text).data.to_dict()
    assert (data["license"], data["library_name"], data["pipeline_tag"]) == (
        "apache-2.0",
        "lerobot",
        "robotics",
    )
    assert data["model-index"][0]["results"][0]["metrics"][0]["value"] == pytest.approx(0.84)
    assert "**84.0%** [75.6%, 89.9%] (95% interval, 100 episodes), on unseen seeds" in text
    assert "--env.task=PandaPickPlace-v0 \\\n  --env.fps=20" in text
    shutil.rmtree(run / "best")
    with pytest.raises(ManipError, match="no policy in"):
        cards(run, "policy", "user/act")
