"""`manip-il reward irl`: bad input is one line; the reward it writes is one that the task takes."""

import json
from pathlib import Path

import pytest

from manip_il.cli.main import main
from manip_il.tasks.carry.reward import FEATURES, Reward

SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"


@pytest.mark.slow
def test_a_reward_is_learnt_from_demonstrations_and_taken_by_the_task(tmp_path, capsys):
    shown, folder = tmp_path / "carry", tmp_path / "irl"
    words = ["--robot.type=panda", "--task.type=carry", "--dataset.num_episodes=3", f"--dataset.root={shown}"]
    assert main(["record", *words, "--dataset.repo_id=a/carry", "--workers=1"]) == 0
    assert main(["reward", "irl", str(shown), "--method=max_margin", f"--output_dir={folder}"]) == 0
    out, err = capsys.readouterr()
    found = json.loads((folder / "reward.json").read_text())
    assert (found["method"], found["demonstrations"]) == ("max_margin", 3)
    assert {*found["names"], *found["not_identified"]} == set(FEATURES)
    assert dict(zip(found["names"], found["weights"], strict=True))["length"] == 1
    for name in found["not_identified"]:
        assert name in err
    reward = Reward.parse(str(folder / "reward.json"))
    assert reward.weights[0] == 1
    assert f"--policy.type=expert --task.type=carry:{folder / 'reward.json'}" in out
    assert "data:image/svg+xml;base64," in (folder / "report.html").read_text()
