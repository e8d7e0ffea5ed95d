"""`eval.json` keeps its contract, survives a round trip, and says what is wrong with a broken file."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from manip_il.evaluation.statistics import confidence_sequence, wilson_interval

from manip_il.errors import ManipError, MismatchError
from manip_il.evaluation.episodes import EpisodeResult, EvalSettings
from manip_il.evaluation.results import EvalResult, compare_results
from manip_il.sim.conditions import Condition

SETTINGS = EvalSettings(horizon=150, tolerance=0.02)


def result(outcomes: list[bool], first_seed: int = 100, **changes: Any) -> EvalResult:
    episodes = tuple(
        EpisodeResult(
            first_seed + i, good, good, steps=40 + i, ret=float(good), phase_at_end="AT_GOAL" if good else "CARRY"
        )
        for i, good in enumerate(outcomes)
    )
    made = EvalResult("mlp", "panda", "pick", {"mujoco": "3.11.0"}, episodes, SETTINGS)
    return replace(made, **changes)


def test_the_keys_are_the_contracts():
    data = result([True, True, False]).to_json()
    assert set(data) == {
        *("success_rate", "interval", "confidence", "n_episodes", "policy", "robot", "task", "fingerprint"),
        *("episodes", "success_at_end_rate", "settings", "interval_method", "until_width", "by_condition"),
        "policy_sha256",
    }
    assert set(data["episodes"][0]) == {"seed", "success", "success_at_end", "steps", "return", "phase_at_end"}
    assert data["settings"] == {
        **{"horizon": 150, "tolerance": 0.02, "control_hz": 20, "success_steps": 5},
        **{"hold": None, "suite": "nominal", "conditions": [{"name": "nominal"}]},
    }
    assert data["by_condition"] == {}  # nothing says which it met
    assert (data["interval_method"], data["until_width"]) == ("Wilson's score interval", None)
    assert data["success_rate"] == 2 / 3
    assert data["interval"] == list(wilson_interval(2, 3))
    assert data["n_episodes"] == 3


def test_what_is_written_is_read_back_equal(tmp_path: Path):
    made = result([True, False, True])
    made.write(tmp_path / "deep" / "eval.json")
    assert EvalResult.read(tmp_path / "deep" / "eval.json") == made
    assert EvalResult.read(tmp_path / "deep") == made
    assert [entry.name for entry in (tmp_path / "deep").iterdir()] == ["eval.json"]


@given(st.lists(st.booleans(), min_size=1, max_size=30), st.floats(allow_nan=False, allow_infinity=False))
def test_json_keeps_every_bit(outcomes: list[bool], ret: float):
    made = result(outcomes)
    made = replace(made, episodes=tuple(replace(e, ret=ret, detail={"push": [ret]}) for e in made.episodes))
    assert EvalResult.from_json(json.loads(json.dumps(made.to_json()))) == made


def test_success_is_told_by_the_condition_that_an_episode_met():
    made = result([True, False, True, True])
    named = tuple(replace(one, detail={"condition": "ab"[i % 2]}) for i, one in enumerate(made.episodes))
    conditions = tuple(Condition(name, mass=(0.1, 0.2)) for name in "ba")
    suite = replace(made, episodes=named, settings=replace(SETTINGS, suite="mine", conditions=conditions))
    assert {name: (one.successes, one.n) for name, one in suite.by_condition.items()} == {"b": (1, 2), "a": (2, 2)}
    assert list(suite.by_condition) == ["b", "a"]
    assert EvalResult.from_json(json.loads(json.dumps(suite.to_json()))) == suite
    assert "mass 0.1 to 0.2" in suite.settings.disturbance


def test_an_evaluation_that_stopped_by_its_width_says_so_and_keeps_its_wider_interval():
    fixed, stopped = result([True] * 9 + [False]), result([True] * 9 + [False], until_width=0.6)
    assert stopped.to_json()["interval"] == list(confidence_sequence(9, 10))
    assert stopped.success.interval[0] < fixed.success.interval[0]
    assert EvalResult.from_json(json.loads(json.dumps(stopped.to_json()))) == stopped


def test_a_file_from_before_there_were_conditions_is_a_nominal_one():
    data = json.loads(json.dumps(result([True]).to_json()))
    data["settings"] = {"horizon": 150, "tolerance": 0.02, "disturbance": "none"}
    assert EvalResult.from_json(data).settings == SETTINGS


def test_failures_are_counted_by_phase():
    assert result([True, False, False]).failures == {"CARRY": 2}
    assert result([True, False]).steps_to_success is None


def test_steps_to_success_counts_the_episodes_that_succeeded():
    made = result([True, True, False])
    counts = (10, 21, None)
    episodes = tuple(replace(e, detail={"steps_to_success": n}) for e, n in zip(made.episodes, counts, strict=True))
    assert replace(made, episodes=episodes).steps_to_success == 15.5


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", "not valid JSON"),
        ('{"success_rate": 0.5, "epis', "not valid JSON"),
        ("[]", "expected an object"),
        ("{}", "is missing"),
    ],
)
def test_a_broken_file_is_named_with_what_is_wrong(tmp_path: Path, content: str, complaint: str):
    path = tmp_path / "eval.json"
    path.write_text(content)
    with pytest.raises(ManipError, match=complaint) as caught:
        EvalResult.read(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value"), [("seed", "1"), ("success", 1), ("steps", 1.5), ("steps", True), ("return", "much")]
)
def test_a_value_of_the_wrong_kind_is_refused(tmp_path: Path, key: str, value: object):
    data = result([True]).to_json()
    data["episodes"][0][key] = value
    (tmp_path / "eval.json").write_text(json.dumps(data))
    with pytest.raises(ManipError, match=r"not an eval\.json"):
        EvalResult.read(tmp_path)


def test_a_file_that_lost_episodes_is_refused(tmp_path: Path):
    data = result([True, False]).to_json()
    data["episodes"].pop()
    (tmp_path / "eval.json").write_text(json.dumps(data))
    with pytest.raises(MismatchError, match="n_episodes has 2, episodes has 1"):
        EvalResult.read(tmp_path)


def test_a_missing_file_says_what_writes_it(tmp_path: Path):
    with pytest.raises(ManipError, match="manip-il eval"):
        EvalResult.read(tmp_path / "eval.json")


def test_no_episode_and_a_repeated_seed_are_refused():
    with pytest.raises(ManipError, match="no episodes"):
        result([])
    made = result([True, True])
    with pytest.raises(ManipError, match="2 episodes on 1 seeds"):
        replace(made, episodes=(made.episodes[0], made.episodes[0]))


def test_results_are_compared_on_the_seeds_they_share():
    comparison = compare_results(result([True, False, False]), result([True, True], first_seed=101, policy="act"))
    assert (comparison.n, comparison.only_right, comparison.only_left) == (2, 2, 0)
    assert (comparison.left, comparison.right) == ("mlp", "act")


def test_unlike_results_are_not_compared():
    with pytest.raises(ManipError, match="share no seed"):
        compare_results(result([True]), result([True], first_seed=500))
    with pytest.raises(MismatchError, match="task differs: mlp has pick, act has push"):
        compare_results(result([True]), result([True], policy="act", task="push"))
    with pytest.raises(MismatchError, match="settings"):
        compare_results(result([True]), result([True], settings=replace(SETTINGS, suite="knocked")))
