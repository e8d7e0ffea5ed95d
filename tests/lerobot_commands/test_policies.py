"""lerobot-train and lerobot-eval on our datasets, policies and environments: the same success
for every seed.
"""

import pytest

from manip_il.cli.main import main
from manip_il.worlds.table import make_config

pytestmark = pytest.mark.slow
UNFILMED = "--env.render_mode=none"  # these tests need no OpenGL


@pytest.fixture(scope="module")
def demos(record):
    return record("reach", 12)


@pytest.mark.parametrize(
    ("space", "policy", "batch_size"),
    [("joint_target", "mlp", 2), ("ee_delta", "act", 3)],
)
def test_lerobot_eval_finds_our_success_for_every_seed_and_needs_no_word_of_the_action_space(
    command, lerobots, trial, demos, small_act, tmp_path, space, policy, batch_size
):
    options = small_act if policy == "act" else {"type": "mlp", "width": 32}
    words = [f"--policy.{name}={value}" for name, value in options.items()]
    words += [
        f"--action_space={space}",
        "--batch_size=64",
        "--steps=300",
        f"--output_dir={tmp_path / 'run'}",
    ]
    assert main(["train", f"--dataset.root={demos}", *words]) == 0
    path = tmp_path / "run/checkpoints/last/pretrained_model"
    evaluation = trial(make_config("panda", "reach", horizon=40, tolerance=0.1), 6)
    few = evaluation.words(batch_size, asynchronous=batch_size == 2)
    command(
        "lerobot-eval", f"--policy.path={path}", *few, UNFILMED, f"--output_dir={tmp_path / 'eval'}"
    )
    theirs, ours = lerobots(tmp_path / "eval"), evaluation.ours(path)
    assert theirs["successes"] == [episode.success for episode in ours]
    assert theirs["sum_rewards"] == [episode.ret for episode in ours]
    assert any(theirs["successes"])


def test_lerobot_trains_our_mlp_on_our_dataset(command, trial, demos, tmp_path):
    command(
        "lerobot-train", "--policy.discover_packages_path=manip_il.learn.mlp", "--policy.type=mlp",
        "--policy.width=64", "--policy.optimizer_lr=3e-3", "--policy.scheduler_warmup_steps=5",
        "--dataset.repo_id=someone/reach", f"--dataset.root={demos}", f"--output_dir={tmp_path / 'run'}",
        "--steps=400", "--batch_size=32", "--num_workers=0",
    )  # fmt: skip
    reach = trial(make_config("panda", "reach", horizon=40, tolerance=0.1), 8)
    episodes = reach.ours(tmp_path / "run/checkpoints/last/pretrained_model")
    assert sum(episode.success for episode in episodes) >= 6
