"""Two sides of any kind meet on the same episodes; what is measured is not measured again.

Bad input is one line.
"""

import json
import shutil
from pathlib import Path

import pytest

from manip_il.cli.main import main

from .made_runs import ENV, make_eval, make_run, mark

GOOD, BAD = [True] * 19 + [False], [True] * 8 + [False] * 12
SIZES = ("--eval.n_episodes=2", "--workers=1")


def compare(*words: object) -> int:
    return main(["compare", *map(str, words)])


def result(folder: Path = Path("runs/compare")) -> dict:
    return json.loads((folder / "compare.json").read_text())


def against(right: str = "b") -> dict:
    return result()["arms"][right]["against_baseline"]


def chosen() -> list[int]:
    """The round of each side's first run."""
    return [arm["training_seeds"][0]["chosen"]["round"] for arm in result()["arms"].values()]


def test_two_evaluations_are_compared_as_they_are(here, capsys, evaluated):
    make_eval(here / "a" / "eval.json", BAD)
    make_eval(here / "b" / "eval.json", GOOD)
    assert compare("a/eval.json", "b") == 0
    out = capsys.readouterr().out
    assert "b is better than a/eval.json by 55.0 points [" in out
    data = against()
    assert (data["n_episodes"], data["only_left"], data["only_right"]) == (20, 0, 11)
    assert data["p_value"] == pytest.approx(2 / 2**11)
    assert evaluated == []


def test_of_a_run_the_rule_takes_the_round(here, policy, capsys):
    make_run(here / "a", policy)
    make_run(here / "b", policy, successes=(0.2, 0.6, 0.4, 0.9), labels=60)
    assert compare("a", "b", *SIZES, "--at=labels", "--checkpoint=last") == 0
    assert result()["rule"] == {"checkpoint": "last", "at": "labels", "limit": 240}
    assert chosen() == [1, 3]
    [right] = result()["arms"]["b"]["training_seeds"]
    assert right["policy"] == "b/round_003/policy/checkpoints/last/pretrained_model"
    assert right["n_episodes"] == 2
    assert result()["test_seeds"] == [4_000_000, 4_000_001]
    out = capsys.readouterr().out
    assert "within 240 labels" in out
    assert "No difference shown between b and a: +0.0 points" in out
    assert compare("a", "b", *SIZES, "--overwrite=true") == 0
    assert chosen() == [1, 3]


def test_what_is_measured_is_not_measured_again_unless_the_policy_is_another(
    here, policy, evaluated, capsys, error
):
    make_run(here / "a", policy)
    make_run(here / "b", policy)
    assert compare("a", "b", *SIZES) == 0
    assert evaluated == ["a", "b"]
    first = result()
    assert compare("a", "b", *SIZES, "--resume=true") == 0
    assert evaluated == ["a", "b"]
    assert result() == first
    mark(here / "b" / "round_001/policy/checkpoints/last/pretrained_model", "trained anew")
    assert compare("a", "b", *SIZES, "--resume=true") == 0
    assert evaluated == ["a", "b", "b"]
    capsys.readouterr()
    assert compare("a", "b", *SIZES, "--resume=true", "--checkpoint=last") == 1
    assert "--checkpoint differs" in error()


def test_training_seeds_are_matched_by_number(here, policy, capsys):
    for seed in (0, 1):
        make_run(here / "a" / f"seed_{seed}", policy, seed)
    for seed in (1, 0):
        make_run(here / "b" / f"seed_{seed}", policy, seed)
    assert compare("a", "b", *SIZES) == 0
    assert "on each of 2 training seeds" in capsys.readouterr().out
    members = result()["arms"]["b"]["training_seeds"]
    assert [(one["seed"], one["name"]) for one in members] == [(0, "b/seed_0"), (1, "b/seed_1")]


def test_a_policy_meets_a_run_in_the_runs_environment(here, policy, evaluated):
    make_run(here / "a", policy)
    shutil.copytree(policy, here / "p")
    assert compare("p", "a", *SIZES) == 0
    assert result()["arms"]["p"]["settings"]["horizon"] == ENV.horizon
    assert compare("p", "a", *SIZES, "--overwrite=true", "--seed=1") == 0
    assert result()["test_seeds"][0] == 114_000_000
    assert evaluated == ["p", "a"] * 2


def sides(here: Path, policy: Path) -> None:
    """What the bad input below names."""
    make_run(here / "run", policy)
    make_run(here / "seeds" / "seed_0", policy, 0)
    for seed in (5, 6):
        make_run(here / "other_seeds" / f"seed_{seed}", policy, seed)
    make_eval(here / "two" / "eval.json", [True, False])
    make_eval(here / "three" / "eval.json", [True, False, True])
    make_eval(here / "lift" / "eval.json", [True, False], task="lift")


@pytest.mark.parametrize(
    ("words", "code", "line"),
    [
        (["run", "other_seeds"], 2, "training seeds differ: run has [None], other_seeds [5, 6]"),
        (
            ["two", "three"],
            1,
            "test episodes of two and three differ; evaluate both with the same --seed",
        ),
        (["two", "lift"], 1, "task differs: two has reach, lift has lift"),
        (
            ["two", "two", "--suite=knocked"],
            2,
            "options of suite change nothing for two evaluations",
        ),
        (
            ["three", "run"],
            2,
            "only one of them is an evaluation; give two eval.json, or two policies",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_one_line_before_any_episode(
    words, code, line, here, policy, evaluated, error
):
    sides(here, policy)
    assert compare(*words) == code
    assert line in error()
    assert evaluated == []
    assert not (here / "runs").is_dir() or not list((here / "runs").iterdir())


def test_runs_of_other_environments_are_refused_by_name(here, policy, error):
    make_run(here / "a", policy)
    make_run(here / "b", policy)
    file = here / "b" / "round_000" / "eval.json"
    file.write_text(file.read_text().replace('"tolerance": 0.02', '"tolerance": 0.03'))
    assert compare("a", "b", *SIZES) == 1
    assert "tolerance differs: a has 0.02, b has 0.03" in error()
    assert compare("a", "b", *SIZES, "--env.tolerance=0.04") == 0
    assert result()["arms"]["b"]["settings"]["tolerance"] == 0.04
