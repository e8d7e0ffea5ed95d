"""`manip-il data redraw`: a dataset to train from, the same on two workers, and read by LeRobot."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.feature_utils import dataset_to_policy_features

from manip_il.cli.main import main
from manip_il.data.dataset import Dataset

from ..damage import digests
from .made_runs import run

SMALL = ("--frames=60", "--image.height=32", "--image.width=32", "--workers=1", "--quiet")


@pytest.fixture(scope="module")
def demos(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("demos") / "demos"
    assert run(f"record --dataset.root={root} --dataset.num_episodes=3 --workers=1") == 0
    return root


@pytest.fixture(scope="module")
def redrawn(demos, tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("redrawn") / "new"
    assert run(f"data redraw {demos} {root}", *SMALL) == 0
    return root


@pytest.mark.gl
@pytest.mark.slow
def test_it_is_a_plain_dataset_of_single_frames(redrawn, demos, capsys):
    info, spec = Dataset.open(redrawn).info, Dataset.open(redrawn).spec
    assert info.episodes == info.frames == 60
    assert (spec.cameras, spec.image_size, spec.video) == (
        ("front", "side", "wrist"),
        (32, 32),
        False,
    )
    assert Dataset.open(redrawn).provenance["redrawn"]["from"] == "demos"
    points = Dataset.open(redrawn).columns([one for one in spec.keypoint_keys])
    assert spec.keypoints[:2] == ("goal", "object")
    for places in points.values():
        assert places.shape == (60, 3 * len(spec.keypoints))
        assert ((places >= 0) & (places <= 1)).all()
        assert places.reshape(60, -1, 3)[:, :2, 2].any()
    assert Dataset.open(redrawn).columns(["label_valid"])["label_valid"].all()
    assert run(f"data check {redrawn}") == 0
    dataset: Any = LeRobotDataset("local/new", root=redrawn)
    assert dataset[7]["observation.images.side"].shape == (3, 32, 32)
    inputs = dataset_to_policy_features(dataset.meta.features)
    assert not any("keypoints" in name for name in inputs)


@pytest.mark.gl
@pytest.mark.slow
def test_without_pictures_it_gives_the_same_scenes_and_a_cnn_learns_to_act_from_them(
    redrawn, demos, tmp_path
):
    states, policy = tmp_path / "states", tmp_path / "policy"
    assert run(f"data redraw {demos} {states} --pictures=false", *SMALL) == 0
    assert Dataset.open(states).spec.cameras == ()
    seen, unseen = (Dataset.open(one).columns(["sim_state", "action"]) for one in (redrawn, states))
    assert all((seen[name] == unseen[name]).all() for name in seen)
    words = f"train --dataset.root={redrawn} --policy.type=cnn --policy.states={states}".split()
    assert (
        main([*words, *f"--policy.width=16 --steps=2 --batch_size=4 --output_dir={policy}".split()])
        == 0
    )
    words = (
        f"eval --policy.path={policy} --eval.n_episodes=1 --env.horizon=10 --workers=1"
    ).split()
    assert main([*words, f"--output_dir={tmp_path / 'eval'}"]) == 0


@pytest.mark.gl
@pytest.mark.slow
def test_dagger_by_pictures_redraws_every_rounds_states_the_same_after_a_kill(
    demos, tmp_path, capsys
):
    run = tmp_path / "run"
    words = (
        f"dagger --dataset.root={demos} --policy.type=cnn --policy.width=16 --redraw=60"
    ).split()
    words += [
        "--rounds=1",
        "--episodes_per_round=2",
        "--hold=1",
        "--env.horizon=20",
        "--steps=2",
        "--batch_size=4",
    ]
    words += ["--validation_episodes=1", *SMALL[1:], f"--output_dir={run}"]
    assert main(words) == 0
    first, second = (run / f"round_{number:03d}" for number in range(2))
    states = [Dataset.open(one / "dataset").info.frames for one in (first, second)]
    scenes = [Dataset.open(one / "redrawn").info.frames for one in (first, second)]
    assert scenes == [60, 60 * states[1] // states[0]]
    assert Dataset.open(first / "redrawn").spec.cameras == ("front", "side", "wrist")
    assert (
        Dataset.open(second / "dataset").spec.cameras
        == Dataset.open(run / "dataset").spec.cameras
        == ()
    )
    seeds = [
        set(Dataset.open(one / "redrawn").columns(["seed"])["seed"].tolist())
        for one in (first, second)
    ]
    assert seeds[0].isdisjoint(seeds[1])
    before = digests(second / "redrawn")
    shutil.rmtree(second / "redrawn")
    shutil.rmtree(second / "policy")
    (second / "eval.json").unlink()
    assert main([*words, "--resume=true"]) == 0
    assert digests(second / "redrawn") == before
    pictured = [
        "dagger",
        f"--dataset.root={first / 'redrawn'}",
        *words[2:-1],
        f"--output_dir={tmp_path / 'other'}",
    ]
    capsys.readouterr()
    assert main(pictured) == 1
    assert "cameras differs" in capsys.readouterr().err
