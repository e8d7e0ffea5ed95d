"""The package's public names: what notebooks and scripts use in place of the commands."""

import ast
from collections.abc import Callable
from pathlib import Path

import pytest

import manip_il
from manip_il.algorithms import imitation
from manip_il.algorithms.config import RunConfig
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.sim.conditions import Condition

SAMPLE = Path(__file__).parents[1] / "datasets" / "sample"
STUB = Path(manip_il.__file__).with_suffix(".pyi")


def test_every_public_name_is_there_and_typed():
    names = next(
        node.value for node in ast.parse(STUB.read_text()).body if isinstance(node, ast.Assign)
    )
    assert ast.literal_eval(names) == sorted(set(dir(manip_il)) - {"__version__"})
    assert [name for name in ast.literal_eval(names) if not getattr(manip_il, name).__doc__] == []


MISTAKES: dict[str, Callable[[Path], object]] = {
    "unknown option 'stepz' (did you mean 'steps'?)": lambda folder: manip_il.train(
        SAMPLE, folder, stepz=3
    ),
    "steps is 'many'": lambda folder: manip_il.train(str(SAMPLE), folder, steps="many"),
    "unknown option 'horizonn' (did you mean 'horizon'?)": lambda _: manip_il.make_config(
        horizonn=3
    ),
    "horizon is 'far'": lambda _: manip_il.make_config(horizon="far"),
    "unknown robot 'pandaa'": lambda folder: manip_il.record(folder / "d", "pandaa", 1),
    "env is 3": lambda folder: manip_il.record(folder / "d", 3, 1),
    "episodes is 'few'": lambda folder: manip_il.record(folder / "d", "panda", "few"),
    "cameras is 'front'": lambda folder: manip_il.record(
        folder / "d", "panda/reach", 1, cameras="front"
    ),
    "unknown option 'roundz' (did you mean 'rounds'?)": lambda folder: manip_il.dagger(
        folder, "panda", roundz=3
    ),
    "the weights of 1 datasets are [1, 2]; expected a number above 0 for each": lambda folder: (
        manip_il.train(SAMPLE, folder / "run", shares=[1, 2])
    ),
    "give it alone, without shares": lambda folder: manip_il.train(
        SAMPLE, folder / "run", shares=[1], weights=folder / "rabc.parquet"
    ),
    "no dataset was given": lambda folder: manip_il.train([], folder / "run"),
    "is not a LeRobot dataset": lambda folder: manip_il.train(folder, folder / "clone"),
}


@pytest.mark.parametrize("said", MISTAKES)
def test_a_mistake_is_one_line_as_on_the_command_line(tmp_path: Path, said: str):
    with pytest.raises(ManipError) as caught:
        MISTAKES[said](tmp_path)
    assert said in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_a_folder_holds_the_results_of_one_set_of_options(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(imitation.Run, "results", lambda run: iter([run.config.rounds]))
    env = manip_il.make_config("panda", "reach")
    assert manip_il.dagger(tmp_path, RunConfig(env, rounds=1)) == [1]
    assert manip_il.dagger(tmp_path, "panda/reach", rounds=2, beta="constant:0") == [2]
    (tmp_path / "round_000").mkdir()
    with pytest.raises(MismatchError, match="seed differs"):
        manip_il.dagger(tmp_path, RunConfig(env, rounds=2, seed=7))
    with pytest.raises(MismatchError, match="fit differs"):
        manip_il.dagger(tmp_path, RunConfig(env, rounds=2, fit=FitConfig(lr=0.5)))


def test_nothing_is_recorded_over_what_is_there(tmp_path: Path):
    (tmp_path / "metrics.jsonl").write_text("mine\n")
    env = manip_il.make_config("panda", "reach")
    with pytest.raises(UsageError, match=str(tmp_path)):
        manip_il.record(str(tmp_path), env, 1)
    with pytest.raises(UsageError, match=str(tmp_path)):
        manip_il.dagger(tmp_path, RunConfig(env))
    with pytest.raises(UsageError, match=str(tmp_path)):
        manip_il.train(SAMPLE, tmp_path)
    assert (tmp_path / "metrics.jsonl").read_text() == "mine\n"


def test_without_a_policy_the_environment_must_be_given():
    with pytest.raises(UsageError, match="env is missing"):
        manip_il.evaluate(episodes=1)


@pytest.mark.slow
def test_a_policys_rollouts_hold_the_experts_labels_and_its_evaluation_knows_its_task(
    tmp_path: Path,
):
    env = manip_il.make_config("panda", "reach")
    demos = manip_il.record(tmp_path / "demos", env, 2).root
    policy = manip_il.train(
        demos, tmp_path / "clone", seed=1000, policy={"width": 16}, steps=2, batch_size=8
    )
    assert len(repr(policy)) < 120 + len(str(tmp_path))
    made = manip_il.record(tmp_path / "made", "panda/reach", 2, policy=policy, beta=0.5)
    table = made.columns(["action", "executed_action", "actor", "label_valid"])
    assert set(table["actor"].ravel()) == {0, 1}
    assert table["label_valid"].all()
    assert (table["action"] != table["executed_action"]).any()
    assert (made.provenance["beta"], made.provenance["round"]) == (0.5, 1)
    found = manip_il.evaluate(
        policy, episodes=2, conditions=(Condition("knocked", action_noise=0.1),)
    )
    assert (found.robot, found.task, found.success.n, found.settings.suite) == (
        "panda",
        "reach",
        2,
        "knocked",
    )
