"""Two sides of any kind meet on the same episodes; what is measured is not measured again; bad input is one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from manip_il.cli.dagger import learning_curve
from manip_il.cli.main import main
from manip_il.evaluation.arm import read_arm

from .made_runs import ENV, OPTIONS, make_eval, make_run, mark

GOOD, BAD = [True] * 19 + [False], [True] * 8 + [False] * 12
SIZES = ("--eval.n_episodes=2", "--workers=1")


def compare(*words: object) -> int:
    return main(["compare", *map(str, words)])


def result(folder: Path = Path("runs/compare")) -> dict:
    return json.loads((folder / "compare.json").read_text())


def test_two_evaluations_are_compared_as_they_are(here, capsys, evaluated):
    make_eval(here / "a" / "eval.json", BAD)
    make_eval(here / "b" / "eval.json", GOOD)
    assert compare("a/eval.json", "b") == 0
    out = capsys.readouterr().out
    assert "b is better than a/eval.json by 55.0 points [" in out
    data = result()
    assert (data["n_episodes"], data["only_left"], data["only_right"]) == (20, 0, 11)
    assert data["p_value"] == pytest.approx(2 / 2**11)
    assert evaluated == []


def test_of_a_run_the_rule_takes_the_round(here, policy, capsys):
    make_run(here / "a", policy)
    make_run(here / "b", policy, successes=(0.2, 0.6, 0.4, 0.9), labels=60)
    assert compare("a", "b", *SIZES, "--at=labels", "--checkpoint=last") == 0
    pair = result()["training_seeds"][0]
    assert result()["rule"] == {"checkpoint": "last", "at": "labels", "limit": 240}
    assert [pair[side]["chosen"]["round"] for side in ("left", "right")] == [1, 3]
    assert pair["right"]["policy"] == "b/round_003/policy/checkpoints/last/pretrained_model"
    assert pair["left"]["n_episodes"] == 2
    assert result()["test_seeds"] == [4_000_000, 4_000_001]
    out = capsys.readouterr().out
    assert "within 240 labels" in out
    assert "No difference shown between b and a: +0.0 points" in out
    assert compare("a", "b", *SIZES, "--overwrite=true") == 0
    pair = result()["training_seeds"][0]
    assert [pair[side]["chosen"]["round"] for side in ("left", "right")] == [1, 3]


def test_what_is_measured_is_not_measured_again_unless_the_policy_is_another(here, policy, evaluated, capsys, error):
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
    assert "on average over 2 training seeds" in capsys.readouterr().out
    assert [pair["left_seed"] for pair in result()["training_seeds"]] == [0, 1]
    assert [pair["right"]["name"] for pair in result()["training_seeds"]] == ["b/seed_0", "b/seed_1"]


def test_a_policy_meets_a_run_in_the_runs_environment(here, policy, evaluated):
    make_run(here / "a", policy)
    shutil.copytree(policy, here / "p")
    assert compare("p", "a", *SIZES) == 0
    assert result()["settings"]["horizon"] == ENV.horizon
    assert compare("p", "a", *SIZES, "--overwrite=true", "--seed=1") == 0
    assert result()["test_seeds"][0] == 114_000_000
    assert evaluated == ["p", "a"] * 2


def test_what_was_not_finite_in_a_fit_is_no_matter(here, policy):
    run = make_run(here / "run", policy)
    before = learning_curve(run)
    assert len(before.runs[0]) == 3
    lines = (run / "metrics.jsonl").read_text().replace('"beta": 0.0', '"beta": 0.0, "grad_norm": NaN')
    assert lines.count("NaN") == 3
    (run / "metrics.jsonl").write_text(lines)
    assert learning_curve(run) == before
    shutil.copytree(policy, here / "fit" / "checkpoints" / "last" / "pretrained_model")
    (here / "fit" / "metrics.jsonl").write_text('{"step": 1, "loss": 0.5, "grad_norm": NaN}\n')
    (source,) = read_arm(here / "fit").members
    assert source.policy == here / "fit" / "checkpoints" / "last" / "pretrained_model"


def test_a_run_that_is_not_finished_is_said_to_be_so(here, policy, capsys):
    make_run(here / "a", policy)
    shutil.rmtree(make_run(here / "b", policy) / "best")
    assert compare("a", "b", *SIZES) == 0
    assert "warning: b is not finished: its 3 rounds count" in capsys.readouterr().err


def sides(here: Path, policy: Path) -> None:
    """What the bad input below names."""
    make_run(here / "run", policy)
    make_run(here / "seeds" / "seed_0", policy, 0)
    for seed in (5, 6):
        make_run(here / "other_seeds" / f"seed_{seed}", policy, seed)
    make_run(here / "named_wrong" / "seed_3", policy, 4)
    shutil.copytree(policy, here / "policy")
    make_eval(here / "two" / "eval.json", [True, False])
    make_eval(here / "three" / "eval.json", [True, False, True])
    make_eval(here / "long" / "eval.json", [True, False], horizon=100)
    make_eval(here / "lift" / "eval.json", [True, False], task="lift")
    (here / "broken.json").write_text("{")
    (here / "empty").mkdir()
    make_run(here / "fresh", policy)
    (here / "fresh" / "metrics.jsonl").unlink()


@pytest.mark.parametrize(
    ("words", "code", "line"),
    [
        (["empty", "run"], 2, "empty holds nothing to compare"),
        (["broken.json", "two"], 1, "broken.json is not valid JSON"),
        (["run", "run"], 2, "compared with itself"),
        (["fresh", "run"], 1, "fresh has no finished round yet"),
        (["run", "other_seeds"], 2, "training seeds differ: run has [0], other_seeds [5, 6]"),
        (["named_wrong", "seeds"], 1, "training seed differs"),
        (["run", "policy", "--at=label"], 2, "did you mean 'labels'?"),
        (["run", "seeds/seed_0", "--at=labels:50"], 2, "run has no round within 50 labels; its first took 100 labels"),
        (["two", "three"], 1, "two has 2, three 3, of which 2 are the same"),
        (["two", "long"], 1, "horizon differs: two has 8, long has 100"),
        (["two", "lift"], 1, "task differs: two has reach, lift has lift"),
        (["three", "run"], 2, "one is evaluated already; give two eval.json, or two policies"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_one_line_before_any_episode(words, code, line, here, policy, evaluated, error):
    sides(here, policy)
    assert compare(*words) == code
    assert line in error()
    assert evaluated == []
    assert not (here / "runs").is_dir() or not list((here / "runs").iterdir())


def test_runs_of_other_environments_are_refused_by_name(here, policy, error):
    make_run(here / "a", policy)
    make_run(here / "b", policy)
    config = here / "b" / "config.yaml"
    config.write_text(config.read_text().replace("tolerance: 0.0\n", "tolerance: 0.03\n"))
    assert compare("a", "b", *SIZES) == 1
    assert "tolerance differs: a has 0.02, b has 0.03" in error()
    assert ENV.tolerance == 0.02, "reach's own, as the run gives none"
    assert "tolerance" not in OPTIONS.env
