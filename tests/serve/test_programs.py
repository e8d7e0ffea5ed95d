"""LeRobot's own programs, unmodified, run to their end against the arm: their keys are pressed
for them.
"""

import json
import shutil
import sys
from collections.abc import Callable
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from numpy.typing import NDArray

from manip_il.cli.main import main
from manip_il.collect.edits import SERVED
from manip_il.data.dataset import Dataset
from manip_il.data.journal import list_episodes, read_journal
from manip_il.mdp import Actor, Episode
from manip_il.serve.config import SessionConfig
from manip_il.serve.station import Station
from manip_il.worlds.table import make_config

pytestmark = pytest.mark.slow
Run = Callable[..., list[Episode]]
_TRIES = 3
# LeRobot waits 50 ms alone
_UNANSWERED = ("There is no status packet", "motor check failed", "Could not connect")


@pytest.fixture
def run(tmp_path: Path, start: Callable[..., ForkServerProcess]) -> Run:
    """Runs a program against `lift`, served by a process of its own.

    Returns what was logged. arms: that it opens.
    """

    def run(
        program: str, *words: str, arms: str = "follower leader", served: tuple[str, ...] = ()
    ) -> list[Episode]:
        root, path = tmp_path / "arm", Path(sys.executable).with_name(program)
        options = [*words]
        for arm in arms.split():
            name = "robot" if arm == "follower" else "teleop"
            values = {
                "type": f"so101_{arm}",
                "id": arm,
                "port": root / arm,
                "calibration_dir": root,
            }
            options += [f"--{name}.{key}={value}" for key, value in values.items()]
        own = [
            "serve",
            "--task.type=lift",
            f"--output_dir={root}",
            f"--log={tmp_path}/log",
            *served,
        ]
        code, said, tries = 1, _UNANSWERED[0], 0
        while code != 0 and any(one in said for one in _UNANSWERED) and tries < _TRIES:
            for old in (folder for folder in tmp_path.iterdir() if folder.name != "arm"):
                shutil.rmtree(old) if old.is_dir() else old.unlink()
            served_by = start(*own, "--", str(path), *options, log=tmp_path / "said")
            served_by.join()
            tries += 1
            code, said = served_by.exitcode, (tmp_path / "said").read_text(errors="replace")
        assert code == 0, said[-3000:]
        return [read_journal(path)[1] for path in list_episodes(tmp_path / "log")]

    return run


def dataset(folder: Path, name: str, episodes: int) -> list[str]:
    """Options of the dataset that a program is to write."""
    options = {
        "repo_id": f"local/{name}",
        "root": str(folder / name),
        "single_task": "lift",
        "push_to_hub": "false",
    }
    return [
        *(f"--dataset.{key}={value}" for key, value in options.items()),
        f"--dataset.num_episodes={episodes}",
    ]


def test_record_keeps_solved_episodes_with_the_frames_of_the_log(run: Run, tmp_path: Path):
    """Beside LeRobot's dataset are states and labels, of which `data build` makes one of ours."""
    logged = run("lerobot-record", *dataset(tmp_path, "t", 2), "--play_sounds=false")
    recorded = LeRobotDataset("local/t", root=tmp_path / "t")
    assert recorded.num_episodes == len(logged) == 2
    assert all(episode.success for episode in logged)
    first = np.stack(recorded.hf_dataset["observation.state"])[0]
    # a step of the encoder
    assert np.abs(first - logged[0].columns["observation.state"][0]).max() < 0.2
    assert abs(len(recorded) - sum(map(len, logged))) <= 2
    assert main(["data", "build", f"{tmp_path}/log", f"{tmp_path}/ours"]) == 0
    # redrawn labels then hold the servos' sag
    assert Dataset.open(tmp_path / "ours").provenance["driver"] == SERVED


def test_teleoperate_follows_the_expert_from_world_to_world(run: Run):
    logged = run("lerobot-teleoperate", "--fps=30", "--teleop_time_s=10")
    assert len(logged) >= 2
    assert logged[0].success
    assert {*np.concatenate([one.columns["actor"] for one in logged]).ravel()} == {Actor.EXPERT}


def ends(folder: Path) -> NDArray[np.int64]:
    """The ends of every joint of a calibrated follower, in steps of its encoder, (n, 2)."""
    kept = json.loads((folder / "arm" / "follower.json").read_text())
    return np.array(
        [
            [one["range_min"], one["range_max"]] + one["homing_offset"] * np.ones(2, int)
            for one in kept.values()
        ]
    )


def test_an_arm_is_calibrated(run: Run, tmp_path: Path):
    """The calibration that is found is the model's, to within two steps; the servos keep it."""
    folder = tmp_path / "model" / "arm"
    Station(make_config("so101", "lift"), SessionConfig(output_dir=folder)).close()
    model = ends(tmp_path / "model")
    run("lerobot-calibrate", arms="follower")
    assert "Calibration saved" in (tmp_path / "said").read_text()
    assert np.abs(ends(tmp_path) - model).max() <= 2


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A checkpoint of a policy that sees one small picture and has hardly learnt."""
    folder = tmp_path_factory.mktemp("policy")
    size = ["--cameras=front", "--image.height=32", "--image.width=32"]
    env = ["--robot.type=so101", "--task.type=lift", "--workers=1"]
    assert (
        main(["record", *env, *size, "--dataset.num_episodes=2", f"--dataset.root={folder}/data"])
        == 0
    )
    fit = [
        "--policy.type=cnn",
        "--policy.channels=[4,4]",
        "--policy.keypoints=4",
        "--policy.width=16",
        "--steps=2",
    ]
    assert main(["train", f"--dataset.root={folder}/data", *fit, f"--output_dir={folder}/run"]) == 0
    return f"{folder}/run/checkpoints/last/pretrained_model"


def rollout(policy: str, port: int, strategy: str) -> list[str]:
    """Options of `lerobot-rollout`."""
    camera = (
        f"type: zmq, server_address: 127.0.0.1, port: {port}, camera_name: front, width: 32,"
        " height: 32, fps: 30"
    )
    return [
        "--env.discover_packages_path=manip_il.lerobot_plugin",
        f"--policy.path={policy}",
        f"--strategy.type={strategy}",
        f"--robot.cameras={{front: {{{camera}}}}}",
        "--device=cpu",
        "--play_sounds=false",
    ]


def pictures(port: int, horizon: int) -> tuple[str, ...]:
    """Options of `serve` for a policy that sees; an attempt lasts two horizons at most."""
    sizes = ["--image.height=32", "--image.width=32", f"--env.horizon={horizon}"]
    return ("--cameras=front", *sizes, f"--camera_port={port}")


def test_attempts_follow_each_other_while_a_program_teleoperates(run: Run):
    """Twice as fast as real time, twice as many end."""
    served = ("--env.horizon=30", "--speed=2")
    logged = run("lerobot-teleoperate", "--fps=60", "--teleop_time_s=5", served=served)
    assert len(logged) >= 3
    assert {*np.concatenate([one.columns["actor"] for one in logged]).ravel()} == {Actor.EXPERT}


@pytest.mark.gl
def test_episodic_rollout_keeps_what_is_not_solved(run: Run, policy: str, tmp_path: Path):
    words = [*rollout(policy, 5632, "episodic"), *dataset(tmp_path, "rollout_t", 2)]
    logged = run("lerobot-rollout", *words, arms="follower", served=pictures(5632, 30))
    assert (
        LeRobotDataset("local/rollout_t", root=tmp_path / "rollout_t").num_episodes
        == len(logged)
        == 2
    )
    assert not any(episode.success for episode in logged)
    assert {*np.concatenate([one.columns["actor"] for one in logged]).ravel()} == {Actor.LEARNER}


@pytest.mark.gl
def test_dagger_corrects_a_policy_that_gets_nowhere(run: Run, policy: str, tmp_path: Path):
    """LeRobot's dataset holds the correction alone, the log the whole attempt, labelled in every
    frame.
    """
    words = [*rollout(policy, 5633, "dagger"), *dataset(tmp_path, "rollout_t", 1)]
    logged = run("lerobot-rollout", *words, served=pictures(5633, 75))
    actors = logged[0].columns["actor"].ravel()
    assert actors[0] == Actor.LEARNER
    assert logged[0].columns["label_valid"].all()
    corrected = LeRobotDataset("local/rollout_t", root=tmp_path / "rollout_t")
    assert corrected.num_episodes == 1
    assert abs(len(corrected) - np.sum(actors == Actor.EXPERT)) <= 2
