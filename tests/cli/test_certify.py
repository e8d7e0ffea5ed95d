"""`manip-il robot certify` writes what it measured and prints it; what cannot be is one line before the first step."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from manip_il.cli.main import main
from manip_il.collect.environments import env_fingerprint
from manip_il.sim.env import ManipEnv
from manip_il.tasks.config import make_config

from .made_runs import make_policy

ENV = make_config("fetch", "reach", horizon=60)
WORDS = ["robot", "certify", "--robot.type=fetch", "--task.type=reach", "--env.horizon=60", "--cases=2", "--workers=1"]


@pytest.fixture
def policy(tmp_path) -> Path:
    """An untrained one for fetch reach."""
    return make_policy(tmp_path / "policy", ENV)


def test_the_file_and_the_tables_say_the_same(tmp_path, capsys):
    folder = tmp_path / "c"
    assert main([*WORDS, f"--output_dir={folder}"]) == 0
    out, err = capsys.readouterr()
    assert "certify fetch reach: 10/10" in err
    data = json.loads((folder / "certificate.json").read_text())
    assert (data["robot"], data["task"], data["policy"]) == ("fetch", "reach", None)
    assert data["fingerprint"] == env_fingerprint(ENV)
    assert data["settings"]["cases"] == 2
    assert [case[0] for case in data["rows"][0]["cases"]] == [5_000_000, 5_000_001]
    lines = out.splitlines()
    for row in data["rows"]:
        line = next(line for line in lines if line.startswith(f"|{row['words']}"))
        assert "100.0 % [" in line
    assert f"at least {data['mu']} steps" in out
    assert "The expert on fetch reach recovers from" in (folder / "report.html").read_text()
    assert (folder / "config.yaml").is_file()


def test_a_policy_brings_its_robot_and_task(policy, tmp_path, capsys):
    words = ["robot", "certify", f"--policy.path={policy}", "--env.horizon=60", "--cases=2", "--workers=1"]
    assert main([*words, f"--output_dir={tmp_path / 'c'}"]) == 0
    out = capsys.readouterr().out
    assert "states that the policy visited" in out
    assert "The policy had solved 0 of 2" in out
    data = json.loads((tmp_path / "c" / "certificate.json").read_text())
    assert data["policy"] == str(policy)
    assert data["rows"][-1]["group"] == "learner"


def test_another_robots_policy_is_refused_before_the_first_step(policy, tmp_path, error, monkeypatch):
    monkeypatch.setattr(ManipEnv, "advance", None)
    words = [*WORDS[:2], "--robot.type=panda", f"--policy.path={policy}", f"--output_dir={tmp_path / 'c'}"]
    assert main(words) == 1
    assert "robot differs: the policy has fetch" in error()
    assert not (tmp_path / "c").exists()
