"""Arms that learn by reinforcement begin with another's demonstrations and policy, and are charged for them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from manip_il.cli.learning import AirlOptions, GailOptions, PpoOptions
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
