"""LeRobot's commands as processes of their own, forked from one that has imported LeRobot and
nothing of ours.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from manip_il.cli.main import main
from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.evaluation.measuring import episode_result
from manip_il.evaluation.results import EpisodeResult
from manip_il.mdp import Episode
from manip_il.seeding import stream_seeds
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import EnvConfig

from ..warm import Warm

PLUGIN = "manip_il.lerobot_plugin"


@pytest.fixture(scope="module")
def command(warm_lerobot: Warm) -> Callable[..., str]:
    """Runs a command as a user would; returns what it said."""

    def run(name: str, *words: object, code: int = 0) -> str:
        done = warm_lerobot.run(name, *words)
        said = done.stdout + done.stderr
        assert done.returncode == code, said[-4000:]
        return said

    return run


@pytest.fixture(scope="session")
def record(tmp_path_factory) -> Callable[..., Path]:
    """Records a few demonstrations of panda's reach, by this project's own command."""

    def run(name: str, episodes: int, *words: str) -> Path:
        root = tmp_path_factory.mktemp(name) / name
        where = [
            f"--dataset.root={root}",
            f"--dataset.repo_id=someone/{name}",
            f"--dataset.num_episodes={episodes}",
        ]
        assert main(["record", "--task.type=reach", "--workers=1", *where, *words]) == 0
        return root

    return run


@dataclass(frozen=True)
class Trial:
    """One evaluation, in LeRobot's words and in ours: the first `count` seeds of the test
    stream.
    """

    env: EnvConfig
    count: int
    cameras: CameraConfig | None = None

    @property
    def seeds(self) -> range:
        return stream_seeds("test", self.count)

    @property
    def env_words(self) -> list[str]:
        words = {
            "discover_packages_path": PLUGIN,
            "type": "manip_il",
            "task": "PandaReach-v0",
            "episode_length": self.env.horizon,
            "tolerance": self.env.tolerance,
        }
        if self.cameras is not None:
            words |= {"observation": "images", "cameras": ",".join(self.cameras.names)}
            words |= {
                "observation_height": self.cameras.height,
                "observation_width": self.cameras.width,
            }
        return [f"--env.{name}={value}" for name, value in words.items()]

    def words(self, batch_size: int, asynchronous: bool) -> list[object]:
        """For lerobot-eval and lerobot-train alike.

        The latter's seed is its evaluation's first too.
        """
        flags = [
            f"--eval.n_episodes={self.count}",
            f"--eval.batch_size={batch_size}",
            f"--seed={self.seeds[0]}",
        ]
        return [*self.env_words, *flags, f"--eval.use_async_envs={str(asynchronous).lower()}"]

    def ours(
        self, policy: Path, on_episode: Callable[[Episode], None] = lambda episode: None
    ) -> tuple[EpisodeResult, ...]:
        """By this project's own evaluation."""
        job = RolloutJob(self.env, PolicyDriver.of(policy), cameras=self.cameras)
        found: dict[int, EpisodeResult] = {}
        with Engine(workers=1) as engine:
            for episode in engine.run(job, self.seeds):
                found[episode.seed] = episode_result(job, episode)
                on_episode(episode)
        return tuple(found[seed] for seed in self.seeds)


@pytest.fixture(scope="session")
def trial() -> type[Trial]:
    return Trial


@pytest.fixture(scope="session")
def lerobots() -> Callable[[Path], dict[str, Any]]:
    """Lists with one value an episode, from the folder of a lerobot-eval."""

    def read(folder: Path) -> dict[str, Any]:
        return json.loads((folder / "eval_info.json").read_text())["per_task"][0]["metrics"]

    return read


@pytest.fixture(scope="session")
def small_act() -> dict[str, Any]:
    """Options of a tiny ACT without downloads."""
    sizes = {
        "dim_model": 32,
        "n_heads": 2,
        "dim_feedforward": 64,
        "n_encoder_layers": 1,
        "n_decoder_layers": 1,
    }
    chunk = {"chunk_size": 5, "n_action_steps": 5, "use_vae": "false", "optimizer_lr": 1e-3}
    return {"type": "act", **sizes, **chunk, "pretrained_backbone_weights": "null", "device": "cpu"}


@pytest.fixture(scope="session")
def act_words(small_act: dict[str, Any]) -> Callable[..., Sequence[str]]:
    """Options of lerobot-train for it."""

    def words(root: Path, output_dir: Path, steps: int) -> list[str]:
        policy = small_act | {"push_to_hub": "false"}
        run = {
            "dataset.repo_id": f"someone/{root.name}",
            "dataset.root": root,
            "output_dir": output_dir,
        }
        run |= dict.fromkeys(("steps", "save_freq", "env_eval_freq"), steps) | {"num_workers": 0}
        return [
            *(f"--policy.{key}={value}" for key, value in policy.items()),
            *(f"--{k}={v}" for k, v in run.items()),
        ]

    return words
