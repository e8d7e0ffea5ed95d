"""`manip-il rl gail` ends with a policy, metrics and a page, and is continued."""

import json
from pathlib import Path

import pytest

from manip_il.cli.main import main

SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"


@pytest.mark.slow
def test_a_run_ends_with_a_policy_metrics_and_a_page_and_goes_on(here, capsys):
    small = (
        "--steps=1 --episodes=2 --ppo.minibatches=1 --ppo.epochs=1 --discriminator.steps=1"
        " --validation_episodes=1"
    )
    words = [
        "rl",
        "gail",
        f"--dataset.root={SAMPLE}",
        *small.split(),
        "--output_dir=run",
        "--quiet",
    ]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "validation success" in out
    assert "manip-il eval --policy.path=run" in out
    [line] = (here / "run" / "metrics.jsonl").read_text().splitlines()
    record = json.loads(line)
    assert {
        "steps",
        "success",
        "kl",
        "return",
        "discriminator_accuracy_expert",
        "log_std",
    } <= record.keys()
    page = (here / "run" / "report.html").read_text()
    assert "GAIL on" in page
    assert "data:image/svg+xml;base64," in page
    assert main([*words, "--resume=true"]) == 0
    assert (here / "run" / "metrics.jsonl").read_text().splitlines() == [line]
