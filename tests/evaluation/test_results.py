"""`eval.json` keeps its contract, survives a round trip, and says what is wrong with a broken
file.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from manip_il.errors import ManipError, MismatchError
from manip_il.evaluation.comparison import Comparison
from manip_il.evaluation.intervals import confidence_sequence, wilson_interval
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings
from manip_il.evaluation.side import Side
from manip_il.sim.conditions import Condition

SETTINGS = EvalSettings(horizon=150, tolerance=0.02)


def result(outcomes: list[bool], first_seed: int = 100, **changes: Any) -> EvalResult:
    episodes = tuple(
        EpisodeResult(first_seed + i, good, good, 40, float(good), "AT_GOAL" if good else "CARRY")
        for i, good in enumerate(outcomes)
    )
    made = EvalResult("mlp", "panda", "pick", {"mujoco": "3.11.0"}, episodes, SETTINGS)
    return replace(made, **changes)


def test_the_keys_are_the_contracts():
    data = result([True, True, False]).to_json()
    assert set(data) == {
        *(
            "success_rate",
            "interval",
            "confidence",
            "n_episodes",
            "policy",
            "robot",
            "task",
            "fingerprint",
        ),
        *(
            "episodes",
            "success_at_end_rate",
            "settings",
            "interval_method",
            "until_width",
            "by_condition",
        ),
        "policy_sha256",
    }
    assert set(data["episodes"][0]) == {
        "seed",
        "success",
        "success_at_end",
        "steps",
        "return",
        "phase_at_end",
    }
    assert data["settings"] == {
        **{"horizon": 150, "tolerance": 0.02, "control_hz": 20, "success_steps": 5},
        **{"hold": None, "suite": "nominal", "conditions": [{"name": "nominal"}], "object": ""},
    }
    assert data["by_condition"] == {}  # no episode names its own
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


def test_success_is_split_by_condition_in_the_order_of_the_settings():
    made = result([True, False, True, True])
    named = tuple(
        replace(one, detail={"condition": "ab"[i % 2]}) for i, one in enumerate(made.episodes)
    )
    conditions = tuple(Condition(name, mass=(0.1, 0.2)) for name in "ba")
    suite = replace(
        made, episodes=named, settings=replace(SETTINGS, suite="mine", conditions=conditions)
    )
    parts = suite.to_json()["by_condition"]
    counts = [(name, part["success_rate"], part["n_episodes"]) for name, part in parts.items()]
    assert counts == [("b", 0.5, 2), ("a", 1.0, 2)]
    assert EvalResult.from_json(json.loads(json.dumps(suite.to_json()))) == suite
    assert "mass 0.1 to 0.2" in suite.settings.disturbance


def test_an_evaluation_that_stopped_by_its_width_says_so_and_keeps_its_wider_interval():
    fixed, stopped = result([True] * 9 + [False]), result([True] * 9 + [False], until_width=0.6)
    assert stopped.to_json()["interval"] == list(confidence_sequence(9, 10))
    assert stopped.success.interval[0] < fixed.success.interval[0]
    assert EvalResult.from_json(json.loads(json.dumps(stopped.to_json()))) == stopped


def compared(left: EvalResult, right: EvalResult) -> Comparison:
    return Comparison(Side.of(left.policy, left), Side.of(right.policy, right))


def test_unlike_results_are_not_compared():
    with pytest.raises(ManipError, match="test episodes of mlp and mlp differ"):
        compared(result([True]), result([True, True]))
    with pytest.raises(MismatchError, match="task differs: mlp has pick, act has push"):
        compared(result([True]), result([True], policy="act", task="push"))
    with pytest.raises(MismatchError, match="suite differs: mlp has nominal, mlp has knocked"):
        compared(result([True]), result([True], settings=replace(SETTINGS, suite="knocked")))


@pytest.mark.parametrize("wrong", [None, [1], {"a": 1}, "a/b\n", True])
def test_a_value_of_another_kind_is_refused_in_one_line(wrong, tmp_path: Path):
    data = result([True]).to_json()
    fields = [
        (data, name)
        for name in ("policy", "robot", "task", "policy_sha256", "until_width", "fingerprint")
    ]
    fields += [(data, name) for name in ("episodes", "settings")]
    fields += [(data["settings"], name) for name in data["settings"]]
    fields += [(data["episodes"][0], name) for name in ("drawn", "condition", "steps_to_success")]
    for container, name in fields:
        before = container.get(name)
        container[name] = wrong
        (tmp_path / "eval.json").write_text(json.dumps(data))
        container[name] = before if before is not None else ABSENT.get(name)
        if fits(name, wrong):
            continue
        with pytest.raises(ManipError) as caught:
            EvalResult.read(tmp_path)
        assert "\n" not in str(caught.value)


ABSENT = {"drawn": {}, "condition": ""}  # what not every episode has


def fits(name: str, value: object) -> bool:
    """Whether a field may hold one of the wrong values."""
    text = isinstance(value, str) and name in ("policy", "policy_sha256", "suite", "condition")
    mapping = isinstance(value, dict) and name in ("fingerprint", "drawn")
    return (
        text or mapping or (value is None and name in ("hold", "until_width", "steps_to_success"))
    )
