"""Arms that learn by reinforcement begin with another's demonstrations and policy, and are charged for them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from manip_il.cli.learning import AirlOptions, GailOptions, PpoOptions
from manip_il.cli.main import main
from manip_il.cli.study import read_plan, with_start_cost, with_start_policy
from manip_il.data.json_lines import read_lines
from manip_il.evaluation.arm import Member
from manip_il.evaluation.rounds import history

from .made_runs import make_run

FILE = """
common: {task.type: reach, rounds: 1, env: {horizon: 100}}
arms:
  cloning: {rounds: 0}
  dagger: {}
  gail: {algorithm: gail, dataset.root: cloning, init: cloning, steps: 300}
  scratch: {algorithm: airl, dataset.root: cloning}
  ppo: {algorithm: ppo, init: cloning, reward: somewhere}
"""
TINY = """
common: {task.type: reach, demonstrations: 2, steps: 30, validation_episodes: 2, policy: {width: 16}}
arms:
  cloning: {rounds: 0}
  gail:
    {algorithm: gail, dataset.root: cloning, init: cloning, steps: 150, episodes: 2, ppo.minibatches: 1, warmup: 0,
    validation_every: 100, validation_episodes: 2}
training_seeds: 1
eval: {n_episodes: 2}
"""


@pytest.fixture
def file(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.yaml").write_text(FILE)
    return tmp_path / "x.yaml"


def test_names_of_arms_become_their_runs_of_the_same_training_seed(file):
    plan = read_plan(file, None)
    assert plan.starts == dict.fromkeys(("cloning", "gail", "scratch", "ppo"), "cloning") | {"dagger": "dagger"}
    start = Path("s/cloning/seed_3/round_000")
    gail, scratch, ppo = (with_start_policy(plan.arms[name], start) for name in ("gail", "scratch", "ppo"))
    assert isinstance(gail, GailOptions)
    assert (gail.dataset.root, gail.init, gail.settings["steps"]) == ([start / "dataset"], start / "policy", 300)
    assert isinstance(scratch, AirlOptions)
    assert (scratch.dataset.root, scratch.init) == ([start / "dataset"], None)
    assert isinstance(ppo, PpoOptions)
    assert (ppo.init, ppo.reward) == (start / "policy", Path("somewhere"))
    assert len({*plan.envs.values()}) == 1


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("algorithm: gail", "algorithm: gale", "arm 'gail': unknown algorithm 'gale'"),
        ("init: cloning, steps", "init: clone, steps", "dataset.root and init are clone, cloning; expected"),
        ("steps: 300", "rounds: 3", "arm 'gail': unknown key in its options: 'rounds'"),
    ],
)
def test_an_arm_that_cannot_begin_is_one_line(before, after, words, file, error):
    assert before in FILE
    file.write_text(FILE.replace(before, after, 1))
    assert main(["compare", str(file.name), "--output_dir=s"]) in (1, 2)
    assert words in error()
    assert not Path("s").exists()


def lines(*validated: float | None) -> list[dict[str, Any]]:
    """Iterations of a run from a clone, a hundred steps each."""
    seconds = {"collect": 1.0, "fit": 2.0, "validate": 4.0}
    return [
        {"iteration": i, "steps": 100 * i, "episodes": 2 * i, "validation_success": rate, "validation_episodes": 10}
        | {"seconds": seconds}
        for i, rate in enumerate(validated)
    ]


def test_iterations_that_were_validated_are_rounds_and_cost_what_all_before_them_took():
    found = history(lines(0.2, None, 0.5, None, 0.4), "x")
    assert [(one.unit, one.round, one.steps, one.labels, one.seconds) for one in found] == [
        ("iteration", 0, 0, 0, 3.0),
        ("iteration", 2, 200, 0, 9.0),
        ("iteration", 4, 400, 0, 15.0),
    ]


def test_a_run_is_charged_for_the_demonstrations_it_begins_with_and_for_the_fit_with_init(file, policy, tmp_path):
    run = make_run(tmp_path / "cloning", policy, 0, (0.2,))
    start = history(read_lines(run / "metrics.jsonl"), "x")[0]
    own, plan = Member(tmp_path, history=history(lines(0.2, 0.5), "x")), read_plan(file, None)
    gail, scratch, dagger = (with_start_cost(plan.arms[name], own, run) for name in ("gail", "scratch", "dagger"))
    assert dagger == own
    for found, seconds in ((gail, start.seconds), (scratch, 1.0)):
        last = found.history[-1]
        assert (last.labels, last.episodes, last.steps) == (100, 2 + 2, 100 + 100)
        assert last.seconds == own.history[-1].seconds + seconds


@pytest.mark.slow
def test_a_study_of_cloning_and_gail_tests_both_and_goes_on(file, tmp_path):
    file.write_text(TINY)
    words = ["compare", file.name, "--output_dir=s", "--workers=1"]
    assert main(words) == 0
    data = json.loads(Path("s/compare.json").read_text())
    [gail] = data["arms"]["gail"]["training_seeds"]
    rounds = gail["rounds"]
    assert (
        rounds[0]["validation_success"]
        == data["arms"]["cloning"]["training_seeds"][0]["rounds"][0]["validation_success"]
    )
    assert rounds[0]["steps"] == rounds[0]["labels"] < rounds[-1]["steps"]
    assert rounds[-1]["labels"] == rounds[0]["labels"]
    assert {one["n_episodes"] for one in (gail, *data["arms"]["cloning"]["training_seeds"])} == {2}
    done = Path("s/gail/seed_0/metrics.jsonl").read_bytes()
    assert main([*words, "--resume=true"]) == 0
    assert Path("s/gail/seed_0/metrics.jsonl").read_bytes() == done
    assert "Validation success over steps" in Path("s/report.html").read_text()
