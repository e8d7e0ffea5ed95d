"""A study runs what is not there, compares all of it, and says in one line what is wrong with
its file.
"""

import json
import re
from pathlib import Path

import pytest

from manip_il.cli.imitation import DaggerOptions
from manip_il.cli.run.imitation import read_plan
from manip_il.errors import MismatchError

from .made_runs import make_run, run

FILE = """
common:
  task.type: reach
  env: {horizon: 8}
  rounds: 2
  policy: {width: 16}
arms:
  cloning: {method: cloning}
  dagger:
training_seeds: 2
eval: {n_episodes: 2}
at: labels
target: 0.6
"""


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.yaml").write_text(FILE)
    return tmp_path


@pytest.fixture
def runs(policy, monkeypatch) -> list[DaggerOptions]:
    """Stands in for `manip-il dagger`; what it was asked for."""
    asked: list[DaggerOptions] = []

    def run(options: DaggerOptions) -> None:
        asked.append(options)
        successes = (0.2, 0.4, 0.6) if options.method == "dagger" else (0.2, 0.2, 0.4)
        make_run(options.output_dir, policy, options.settings["seed"], successes)

    monkeypatch.setattr("manip_il.cli.run.imitation.run_dagger", run)
    return asked


def study(*words: str) -> int:
    return run("compare x.yaml --output_dir=s --workers=1", *words)


def test_every_arm_runs_with_every_training_seed_and_its_own_options(here, runs):
    assert study() == 0
    expected = [(seed, method) for seed in range(2) for method in ("cloning", "dagger")]
    assert [(options.settings["seed"], options.method) for options in runs] == expected
    assert [str(options.output_dir) for options in runs] == [
        f"s/{method}/seed_{seed}" for seed, method in expected
    ]
    assert all(
        options.env["horizon"] == 8 and options.fit["policy"] == {"width": 16} for options in runs
    )
    assert all(options.resume and options.workers == 1 for options in runs)


def test_the_answer_is_printed_and_written(here, runs, capsys):
    assert study() == 0
    out = capsys.readouterr().out
    assert "No difference shown between dagger and cloning: +0.0 points" in out
    assert "within 300 labels, which every run reached" in out
    data = json.loads((here / "s" / "compare.json").read_text())
    assert data["baseline"] == "cloning"
    assert data["rule"] == {"checkpoint": "best", "at": "labels", "limit": 300}
    first = data["arms"]["dagger"]["training_seeds"][0]
    assert (first["chosen"]["round"], first["first_at_target"]["labels"], first["n_episodes"]) == (
        2,
        300,
        2,
    )
    assert data["arms"]["cloning"]["training_seeds"][1]["first_at_target"] is None
    page = (here / "s" / "report.html").read_text()
    assert page.count('alt="Validation success over') == 3


def test_finished_runs_and_evaluations_are_not_made_again(here, runs, evaluated):
    assert study() == 0
    assert (len(runs), len(evaluated)) == (4, 4)
    (here / "s" / "dagger" / "seed_1" / "report.html").unlink()  # the last that a run writes
    for path in (here / "s" / "dagger" / "seed_1").iterdir():
        path.rename(here / path.name)
    assert study("--resume=true") == 0
    assert [str(options.output_dir) for options in runs[4:]] == ["s/dagger/seed_1"]
    assert len(evaluated) == 4  # its policies came out the same
    assert study("--resume=true", "--training_seeds=3") == 0
    assert [str(options.output_dir) for options in runs[5:]] == [
        "s/cloning/seed_2",
        "s/dagger/seed_2",
    ]
    assert evaluated[4:] == ["s/cloning/seed_2", "s/dagger/seed_2"]


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (
            "method: cloning",
            "metod: cloning",
            "x.yaml: arm 'cloning': unknown key in its options: 'metod'",
        ),
        ("rounds: 2", "seed: 2", "x.yaml: arm 'cloning': seed is set by the study for every run"),
        ("  dagger:", "  ../dagger:", "its name, which becomes a folder, is '../dagger'"),
        ("method: cloning", "env.horizon: 9", "horizon differs: cloning has 9, dagger has 8"),
    ],
)
def test_a_file_that_is_not_sound_is_one_line_before_anything_runs(
    before, after, words, here, runs, error
):
    assert before in FILE
    (here / "x.yaml").write_text(FILE.replace(before, after, 1))
    assert study() in (1, 2)
    assert words in error()
    assert runs == []
    assert not (here / "s").exists()


def test_arms_of_different_tasks_have_no_baseline_and_each_its_own_environment(here):
    text = FILE.replace("  dagger:", "  lift: {task.type: lift}")
    (here / "x.yaml").write_text(text)
    plan = read_plan(here / "x.yaml")
    assert plan.baseline is None
    assert [env.task for env in plan.envs.values()] == ["reach", "lift"]
    (here / "x.yaml").write_text(text + "baseline: lift\n")
    with pytest.raises(MismatchError, match="task differs: cloning has reach, lift has lift"):
        read_plan(here / "x.yaml")


def test_the_studies_that_come_along_are_sound_and_say_their_own_commands(tmp_path):
    paths = sorted((Path(__file__).parents[2] / "configs/studies").glob("*.yaml"))
    assert len(paths) >= 5
    for path in paths:
        copy = tmp_path / path.name
        # which are made before
        copy.write_text(re.sub(r"dataset\.root: \w+/[^,}\n]+,? ?", "", path.read_text()))
        plan = read_plan(copy)
        assert (plan.baseline is None) == (len({env.task for env in plan.envs.values()}) > 1)
        first = path.read_text().splitlines()[0]
        assert (
            first == f"# manip-il compare configs/studies/{path.name} --output_dir=runs/{path.stem}"
        )
