"""Runs on a very small scale: what it leaves on disk, and that a stopped run goes on as if it
had not been.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.algorithms import run as runs
from manip_il.algorithms.config import BetaSchedule, RunConfig
from manip_il.algorithms.results import Result, best_result
from manip_il.algorithms.rounds import round_folder
from manip_il.algorithms.run import Run
from manip_il.collect.workers import Engine
from manip_il.data.atomic import read_lines
from manip_il.data.dataset import Dataset, joined_columns
from manip_il.evaluation.results import EvalResult
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.fit_config import FitConfig
from manip_il.mdp import Actor, Episode
from manip_il.seeding import stream_seeds
from manip_il.sim.config import CameraConfig
from manip_il.worlds.several import divide
from manip_il.worlds.table import env_spec, make_config

from ..conftest import watching
from ..damage import check_same_data, digests
from ..learn.tiny_policies import ACT

pytestmark = pytest.mark.slow  # every test here waits for a whole run

ALONE = BetaSchedule("constant", 0)
CONFIG = RunConfig(
    env=make_config("fetch", "reach", horizon=40),
    demonstrations=4,
    rounds=1,
    episodes_per_round=2,
    beta=BetaSchedule("constant", 0.5),
    fit=FitConfig({"width": 16}, steps=20, batch_size=32),
    validation_episodes=2,
)


def datasets(folder: Path, last: int) -> list[Path]:
    """Those of rounds 0 to `last`."""
    roots = (round_folder(folder, i) / "dataset" for i in range(last + 1))
    return [root for root in roots if root.is_dir()]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> tuple[Path, list[Result], list[Episode]]:
    """One whole run: its folder, its rounds, and every episode that it made."""
    folder, made = tmp_path_factory.mktemp("dagger"), list[Episode]()
    results = list(Run(CONFIG, folder, Engine(), watching(episode=made.append)).results())
    return folder, results, made


def test_a_round_leaves_its_episodes_dataset_policy_and_evaluation_and_the_run_its_best_policy(run):
    folder, results, _ = run
    for round_, episodes in enumerate((4, 2)):
        here = round_folder(folder, round_)
        assert Dataset.open(here / "dataset").info.episodes == episodes
        assert (results[round_].policy / "model.safetensors").is_file()
        assert EvalResult.read(here / "eval.json") == results[round_].validation
    assert digests(folder / "best" / "pretrained_model") == digests(best_result(results).policy)
    for path in (folder / "best" / "pretrained_model").glob("*.json"):
        assert str(folder) not in path.read_text(), f"{path.name} names a folder of this machine"


def test_the_numbers_of_a_round_are_those_of_its_data(run):
    folder, results, _ = run
    assert [result.number for result in results] == [0, 1]
    assert [result.metrics["beta"] for result in results] == [1.0, 0.5]
    assert [result.episodes for result in results] == [4, 6]
    for result in results:
        table = joined_columns(
            datasets(folder, result.number), ("observation.state", "action", "label_valid")
        )
        assert result.labels == table["label_valid"].sum()
        record = result.to_json()
        assert record["validation_success"] == result.validation.success.rate
        assert record["labels"] == result.labels
    assert results[0].metrics["rollout_success"] == 1.0  # demonstrations are successes
    assert results[0].labels < results[1].labels


def test_every_seed_is_from_its_own_stream(run):
    folder, _, made = run
    for round_, stream, count in ((0, "demonstrations", 4), (1, "round/1", 2)):
        table = Dataset.open(round_folder(folder, round_) / "dataset").columns(
            ("seed", "round", "beta")
        )
        assert set(table["seed"].ravel()) == set(stream_seeds(stream, count))
        assert set(table["round"].ravel()) == {round_}
    seeds = {episode.seed for episode in made}
    streams = [("demonstrations", 4), ("round/1", 2), ("validation", 2)]
    assert seeds == {seed for stream, count in streams for seed in stream_seeds(stream, count)}


def test_the_aggregated_dataset_holds_both_actions_and_who_drove(run):
    folder, _, _ = run
    table = Dataset.open(folder / "dataset").columns(
        ("action", "executed_action", "actor", "round", "episode_index")
    )
    round_, actor = table["round"].ravel(), table["actor"].ravel()
    assert len(np.unique(table["episode_index"])) == 6
    np.testing.assert_array_equal(
        table["action"],
        joined_columns(datasets(folder, 1), ("observation.state", "action", "label_valid"))[
            "action"
        ],
    )
    assert set(actor[round_ == 0]) == {Actor.EXPERT}
    np.testing.assert_array_equal(
        table["action"][round_ == 0], table["executed_action"][round_ == 0]
    )
    assert {Actor.LEARNER} < set(actor[round_ == 1])
    learner = actor == Actor.LEARNER
    assert (table["action"][learner] != table["executed_action"][learner]).any(axis=1).all()


def test_running_it_again_computes_nothing_anew(run, monkeypatch):
    folder, results, _ = run
    before = digests(folder)

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("nothing is left to do")

    monkeypatch.setattr(Engine, "run", refuse)
    logged: list[dict] = []
    again = list(Run(CONFIG, folder, Engine(), watching(log=logged.append)).results())
    assert logged == []
    assert [replace(result, seconds={}) for result in again] == [
        replace(result, seconds={}) for result in results
    ]
    assert digests(folder) == before


class Stop(Exception):
    pass


# in the demonstrations, in round 1, in a validation
@pytest.mark.parametrize("episodes", [2, 5, 7])
def test_a_run_that_was_stopped_goes_on_to_the_same_bytes(run, tmp_path, episodes: int):
    whole, results, _ = run
    count = 0

    def stop(episode: Episode) -> None:
        nonlocal count
        count += 1
        if count == episodes:
            raise Stop

    with pytest.raises(Stop):
        list(Run(CONFIG, tmp_path, Engine(), watching(episode=stop)).results())
    again = list(Run(CONFIG, tmp_path, Engine()).results())
    assert [result.validation for result in again] == [result.validation for result in results]
    assert [line["round"] for line in read_lines(tmp_path / "metrics.jsonl")] == [
        one.number for one in results
    ]
    check_same_data(tmp_path, whole)


def test_a_warm_refit_begins_where_the_last_round_ended(run, tmp_path, begun):
    results = list(Run(replace(CONFIG, refit="warm"), tmp_path, Engine()).results())
    assert set(begun) == {None, results[0].policy}
    assert digests(results[1].policy) != digests(run[1][1].policy)


@pytest.fixture
def begun(monkeypatch) -> list[Path | None]:
    """Where fits begin, from now on."""
    found: list[Path | None] = []
    plain = runs.round_fit

    def watch(config, *rest):
        fit = plain(config, *rest)
        found.append(fit.init_from)
        return fit

    monkeypatch.setattr(runs, "round_fit", watch)
    return found


def test_a_run_begins_with_recorded_demonstrations_in_place_of_its_own(run, tmp_path):
    given = tuple(datasets(run[0], 1))
    config = replace(CONFIG, datasets=given, beta=ALONE)
    results = list(Run(config, tmp_path / "run", Engine()).results())
    assert results[0].episodes == sum(Dataset.open(root).info.episodes for root in given)
    assert results[0].labels == joined_columns(given, ("label_valid",))["label_valid"].sum()
    assert not (round_folder(tmp_path / "run", 0) / "journals").exists()
    assert results[1].labels > results[0].labels
    aggregated = Dataset.open(tmp_path / "run" / "dataset").columns(("action",))["action"]
    np.testing.assert_array_equal(
        aggregated[: results[0].labels], joined_columns(given, ("action",))["action"]
    )
    again = list(Run(config, tmp_path / "run", Engine()).results())
    assert [result.validation for result in again] == [result.validation for result in results]


@pytest.mark.parametrize("with_data", [False, True])
def test_a_run_begins_with_a_policy_and_goes_on_from_its_weights(
    run, tmp_path, begun, with_data: bool
):
    folder, before, _ = run
    start = before[1].policy
    config = replace(
        CONFIG, start=start, datasets=tuple(datasets(folder, 0)) if with_data else (), beta=ALONE
    )
    results = list(Run(config, tmp_path, Engine()).results())
    assert digests(results[0].policy) == digests(start)
    assert (results[0].labels > 0) == with_data
    assert set(begun) == {start}  # round 0 fits nothing
    assert results[1].labels > results[0].labels
    assert list(Run(config, tmp_path, Engine()).results())[1].labels == results[1].labels


def labels(folder: Path, rounds: int) -> int:
    return int(joined_columns(datasets(folder, rounds), ("label_valid",))["label_valid"].sum())


def test_a_budget_of_labels_is_kept_to_the_label_and_ends_the_run(tmp_path):
    config = replace(CONFIG, rounds=5, beta=ALONE, label_budget=180)
    results = list(Run(config, tmp_path, Engine()).results())
    assert [result.labels for result in results][-1] == 180 == labels(tmp_path, results[-1].number)
    assert results[-1].number < 5
    assert Dataset.open(tmp_path / "dataset").info.frames >= 180


@pytest.mark.parametrize("method", ["cloning", "dart"])
def test_what_dagger_is_compared_with_learns_from_expert_states(method, tmp_path):
    results = list(Run(replace(CONFIG, method=method, beta=ALONE), tmp_path, Engine()).results())
    table = joined_columns(
        datasets(tmp_path, 1), ("actor", "round", "seed", "executed_action", "action")
    )
    later = table["round"].ravel() == 1
    drove = {"cloning": Actor.EXPERT, "dart": Actor.NOISY_EXPERT}[method]
    assert (table["actor"].ravel()[later] == drove).all()
    assert np.array_equal(table["executed_action"], table["action"]) == (method == "cloning")
    assert set(table["seed"].ravel()[later]) <= set(stream_seeds("round/1", 10))
    held_out = tmp_path / "held_out/dataset"
    assert held_out.is_dir() == (method == "dart")
    extra = Dataset.open(held_out).info.frames if method == "dart" else 0
    assert results[1].steps >= results[1].labels + extra


@pytest.mark.parametrize(
    ("label", "length"), [("per_state", None), ("takeover", None), ("branch", 4)]
)
def test_a_policy_that_plans_goes_through_the_loop_with_every_kind_of_label(
    label, length, tmp_path
):
    config = replace(
        CONFIG, beta=ALONE, fit=FitConfig(ACT, steps=4, batch_size=8), label=label, refit="warm"
    )
    results = list(Run(config, tmp_path, Engine()).results())
    assert results[1].labels > results[0].labels
    assert json.loads((results[1].policy / "config.json").read_text())["type"] == "act"
    table = joined_columns(
        datasets(tmp_path, 1), ("episode_index", "round", "actor", "label_valid")
    )
    later = table["round"].ravel() == 1
    by_learner = table["actor"].ravel()[later] == Actor.LEARNER
    assert by_learner.all() if label == "per_state" else not by_learner.any()
    if length is not None:
        assert set(np.unique(table["episode_index"].ravel()[later], return_counts=True)[1]) == {
            length
        }


@pytest.mark.gl
def test_a_blind_learner_is_taught_by_an_expert_that_sees_everything(tmp_path):
    fit = FitConfig(
        {"type": "cnn", "device": "cpu", "width": 16}, steps=2, batch_size=4, image_augment=False
    )
    cameras, env = CameraConfig(("front",), 64, 64), make_config("panda", "reach", horizon=20)
    config = replace(
        CONFIG,
        beta=ALONE,
        demonstrations=2,
        env=env,
        fit=fit,
        cameras=cameras,
        validation_episodes=1,
    )
    results = list(Run(config, tmp_path, Engine()).results())
    assert results[1].labels > results[0].labels
    sees = json.loads((results[1].policy / "config.json").read_text())["input_features"]
    assert set(sees) == {"observation.state", "observation.images.front"}
    merged = Dataset.open(tmp_path / "dataset").info
    assert merged.episodes == sum(
        Dataset.open(root).info.episodes for root in datasets(tmp_path, 1)
    )


def test_several_tasks_are_one_run_whose_rollouts_are_where_its_policy_fails(tmp_path):
    env = make_config("fetch", "reach,lift", horizon=40)
    config = replace(CONFIG, env=env, episodes_per_round=8, validation_episodes=4)
    results = list(Run(config, tmp_path, Engine()).results())
    first, second = (Dataset.open(path) for path in datasets(tmp_path, 1))
    assert sorted(first.tasks) == [0, 1]
    texts = [env_spec(make_config("fetch", task)).instruction for task in ("reach", "lift")]
    assert [first.episodes.tasks.count([text]) for text in texts] == [2, 2]
    parts = results[0].validation.by_task
    failed = [2 - parts[task].success.successes for task in ("reach", "lift")]
    wanted = divide(8, [(count + 1) / 4 for count in failed])
    assert [second.episodes.tasks.count([text]) for text in texts] == wanted
    assert Checkpoint.open(results[1].policy).config["reads_text"]
