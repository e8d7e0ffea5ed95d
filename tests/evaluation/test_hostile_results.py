"""An `eval.json` or `metrics.jsonl` with odd values is refused in one short line."""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from manip_il.errors import ManipError, UsageError
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.rounds import history
from manip_il.mdp import LONGEST_EPISODE
from manip_il.sim.env import EnvConfig

GOOD: dict[str, Any] = {
    "policy": "runs/a",
    "robot": "panda",
    "task": "reach",
    "fingerprint": {},
    "settings": {"horizon": 100, "tolerance": 0.02, "conditions": [{"name": "nominal"}]},
    "episodes": [{"seed": 5, "success": True, "steps": 10, "return": 1.0}],
}
LINE: dict[str, Any] = {
    "round": 0,
    "labels": 10,
    "episodes": 2,
    "seconds": {"collect": 1.0, "fit": 1.0, "validate": 1.0},
    "validation_episodes": 4,
    "validation_success": 0.5,
}
ODD = (None, True, -5, 2**80, 10**9, 0.5, "x" * 100_000, [], {}, [[]] * 1_000, {"a": {"a": 1}})


def changed(tree: dict[str, Any], path: tuple[Any, ...], value: object) -> dict[str, Any]:
    tree = deepcopy(tree)
    place: Any = tree
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return tree


def refused(path: Path, text: str) -> str:
    path.write_text(text)
    with pytest.raises(ManipError) as raised:
        EvalResult.read(path)
    message = str(raised.value)
    assert len(message) < 1_000
    assert "\n" not in message
    assert str(path) in message
    return message


@pytest.mark.parametrize(
    ("path", "values"),
    [
        (("episodes", 0, "seed"), [-5, 2**80, 1.5, None, "5", True]),
        (("episodes", 0, "success"), [1, None, "true"]),
        (("episodes", 0, "steps"), [-1, 10**9, 0.5, None]),
        (("episodes", 0, "return"), ["1", None, []]),
        (("episodes", 0, "phase_at_end"), [1, "x" * 100_000]),
        (("episodes", 0, "steps_to_success"), [-1, "x", [1]]),
        (("episodes", 0, "condition"), [1, []]),
        (("episodes", 0, "drawn"), [1, [1]]),
        (("episodes", 0), [None, [], 5]),
        (("episodes",), [None, {}, 5, []]),
        (("settings", "horizon"), [10**9, 0, -1, None, "100", True]),
        (("settings", "tolerance"), [-1, 2, None, "x"]),
        (("settings", "control_hz"), [0, 10**9]),
        (("settings", "success_steps"), [0, 10**9]),
        (("settings", "hold"), [-1, 10**9, "x"]),
        (("settings", "conditions"), [{}, [1], [{}], [{"name": "../x"}], [{"name": "a", "knock": 10**400}]]),
        (("settings",), [None, [], 5]),
        (("robot",), ["../x", None, 5]),
        (("task",), ["a/b", None]),
        (("policy",), [None, 5, "x" * 100_000]),
        (("fingerprint",), [None, [], "x"]),
        (("confidence",), [0, 2, None, "x"]),
        (("until_width",), [-1, 2, "x"]),
        (("n_episodes",), [2**80, "x" * 100_000, []]),
    ],
    ids=lambda value: ".".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_an_odd_value_in_an_eval_json_is_one_short_line(tmp_path, path, values):
    (tmp_path / "eval.json").write_text(json.dumps(GOOD))
    assert EvalResult.read(tmp_path / "eval.json").episodes[0].seed == 5
    for value in values:
        refused(tmp_path / "eval.json", json.dumps(changed(GOOD, path, value)))


@pytest.mark.parametrize("text", ["[" * 100_000, json.dumps(GOOD).replace("1.0", "NaN"), "[]", "{", '{"a": 1}'])
def test_what_is_no_json_object_is_one_short_line(tmp_path, text: str):
    refused(tmp_path / "eval.json", text)


@pytest.mark.parametrize("key", [key for key in LINE if key != "round"])
def test_an_odd_value_in_metrics_is_one_short_line(key: str):
    assert len(history([LINE], "run")) == 1
    sound = {"labels": (10**9,), "episodes": (10**9,), "validation_episodes": (10**9,), "validation_success": (0.5,)}
    for value in ODD:
        if value is not True and value in sound.get(key, ()):
            continue
        with pytest.raises(ManipError) as raised:
            history([LINE | {key: value}], "run")
        assert len(str(raised.value)) < 1_000


@pytest.mark.parametrize("value", ODD)
def test_a_line_of_no_round_is_one_short_line(value):
    with pytest.raises(ManipError, match=r"run: metrics\.jsonl has no round 0"):
        history([LINE | {"round": value}], "run")


def test_no_episode_is_longer_than_the_longest():
    assert EnvConfig(horizon=LONGEST_EPISODE).horizon == LONGEST_EPISODE
    with pytest.raises(UsageError, match="horizon is 1000000000; expected at most 10000 control steps"):
        EnvConfig(horizon=10**9)
