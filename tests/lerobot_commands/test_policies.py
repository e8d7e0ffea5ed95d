"""lerobot-train and lerobot-eval on our datasets, policies and environments: the same success for every seed."""

from __future__ import annotations

import ast
import re

import pytest

from manip_il.cli.main import main
from manip_il.sim.env import EnvConfig

pytestmark = pytest.mark.slow
UNFILMED = "--env.render_mode=none"  # these tests need no OpenGL
SMALL_ACT = {"type": "act", "device": "cpu", "dim_model": 32, "n_heads": 2, "dim_feedforward": 64} | {
    "n_encoder_layers": 1, "use_vae": "false", "chunk_size": 5, "n_action_steps": 5, "optimizer_lr": 1e-3,
    "pretrained_backbone_weights": "null",
}  # fmt: skip


@pytest.fixture(scope="module")
def demos(record):
    return record("reach", 12)


@pytest.fixture(scope="module")
def mlp(demos, tmp_path_factory):
    """A checkpoint of `manip-il train` that gets there on some seeds only."""
    folder = tmp_path_factory.mktemp("mlp") / "run"
    words = [f"--dataset.root={demos}", "--steps=80", "--policy.width=32", f"--output_dir={folder}"]
    assert main(["train", *words]) == 0
    return folder / "checkpoints/last/pretrained_model"


@pytest.fixture(scope="module")
def mlp_trial(trial, mlp):
    """The evaluation of the mlp, and our results of it."""
    evaluation = trial(EnvConfig("panda", "reach", horizon=40, tolerance=0.1), 12)
    ours = evaluation.ours(mlp)
    assert {episode.success for episode in ours} == {True, False}  # else equality would say little
    return evaluation, ours


@pytest.mark.parametrize(("asynchronous", "batch_size"), [(False, 5), (True, 2)], ids=["sync", "async"])
def test_lerobot_eval_finds_our_mlps_success_for_every_seed(
    command, lerobots, mlp, mlp_trial, tmp_path, asynchronous, batch_size
):
    evaluation, ours = mlp_trial
    words = evaluation.words(batch_size, asynchronous)
    command("lerobot-eval", f"--policy.path={mlp}", *words, UNFILMED, f"--output_dir={tmp_path}")
    theirs = lerobots(tmp_path)
    assert theirs["successes"] == [episode.success for episode in ours]
    assert theirs["sum_rewards"] == [episode.ret for episode in ours]


@pytest.mark.parametrize(
    ("space", "policy"),
    [
        ("joint_target", {"type": "mlp", "width": 32}),
        ("ee_delta", {"type": "mlp", "width": 32}),
        ("joint_delta", SMALL_ACT),
        ("ee_delta", SMALL_ACT),
    ],
    ids=["mlp-joint_target", "mlp-ee_delta", "act-joint_delta", "act-ee_delta"],
)
def test_lerobot_eval_needs_no_word_of_the_action_space(command, lerobots, trial, demos, tmp_path, space, policy):
    words = [f"--policy.{name}={value}" for name, value in policy.items()]
    words += [f"--action_space={space}", "--batch_size=64", "--steps=300", f"--output_dir={tmp_path / 'run'}"]
    assert main(["train", f"--dataset.root={demos}", *words]) == 0
    path = tmp_path / "run/checkpoints/last/pretrained_model"
    evaluation = trial(EnvConfig("panda", "reach", horizon=40, tolerance=0.1), 6)
    few = evaluation.words(3, asynchronous=False)
    command("lerobot-eval", f"--policy.path={path}", *few, UNFILMED, f"--output_dir={tmp_path / 'eval'}")
    theirs, ours = lerobots(tmp_path / "eval"), evaluation.ours(path)
    assert theirs["successes"] == [episode.success for episode in ours]
    assert theirs["sum_rewards"] == [episode.ret for episode in ours]
    assert any(theirs["successes"])


def test_lerobot_trains_act_with_evaluation_and_each_seed_ends_the_same_everywhere(
    command, lerobots, trial, demos, act_words, tmp_path
):
    env = EnvConfig("panda", "reach", horizon=40, tolerance=0.1)
    few, many = trial(env, 4), trial(env, 12)
    train = act_words(demos, tmp_path / "run", steps=150)
    said = command("lerobot-train", *train, "--batch_size=16", *few.words(2, asynchronous=False), UNFILMED)
    policy = tmp_path / "run/checkpoints/last/pretrained_model"
    words = many.words(5, asynchronous=False)
    command("lerobot-eval", f"--policy.path={policy}", *words, UNFILMED, f"--output_dir={tmp_path / 'eval'}")

    ours = many.ours(policy)
    successes = [episode.success for episode in ours]
    assert set(successes) == {True, False}
    assert lerobots(tmp_path / "eval")["successes"] == successes
    assert lerobots(tmp_path / "eval")["sum_rewards"] == [episode.ret for episode in ours]
    during = re.search(r"'successes': (\[.*?\])", said)
    assert during is not None
    assert ast.literal_eval(during.group(1)) == successes[:4]


def test_lerobot_trains_our_mlp_on_our_dataset(command, trial, demos, tmp_path):
    command(
        "lerobot-train", "--policy.discover_packages_path=manip_il.learn.mlp", "--policy.type=mlp",
        "--policy.width=64", "--policy.optimizer_lr=3e-3", "--policy.scheduler_warmup_steps=5",
        "--dataset.repo_id=someone/reach", f"--dataset.root={demos}", f"--output_dir={tmp_path / 'run'}",
        "--steps=400", "--batch_size=32", "--num_workers=0",
    )  # fmt: skip
    reach = trial(EnvConfig("panda", "reach", horizon=40, tolerance=0.1), 8)
    episodes = reach.ours(tmp_path / "run/checkpoints/last/pretrained_model")
    assert sum(episode.success for episode in episodes) >= 6
