"""Runs of `manip-il dagger` as they lie on disk, made without running anything."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from manip_il.cli.imitation import DaggerOptions
from manip_il.cli.main import main
from manip_il.cli.outputs import save_options
from manip_il.collect.job import HOLD
from manip_il.data import schema
from manip_il.data.atomic import append_line
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings
from manip_il.learn.checkpoint import META_FILE, Origin
from manip_il.mdp import Episode
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.contract import EnvironmentSpec
from manip_il.worlds.table import env_fingerprint, env_spec, make_config

from ..damage import edit_json
from ..learn.tiny_policies import write_checkpoint

ENV = make_config("panda", "reach", horizon=8)
OPTIONS = DaggerOptions(env={"task": "reach", "horizon": 8})
SUCCESSES = (0.2, 0.6, 0.4)


def run(line: str, *words: str) -> int:
    """Run `manip-il` with the words of a line, and more; return the exit code."""
    return main([*line.split(), *words])


def files(root: Path) -> dict[str, bytes]:
    """Content of every file by its path in `root`."""
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def make_episode(spec: EnvironmentSpec, seed: int, length: int) -> Episode:
    """A solved one: right columns, random numbers."""
    rng = np.random.default_rng(seed)
    columns = {}
    for key, feature in schema.features(spec).items():
        shape = (length, *feature["shape"])
        drawn = rng.normal(size=shape) if "float" in feature["dtype"] else rng.integers(0, 2, shape)
        columns[key] = drawn.astype(feature["dtype"])
    columns[schema.SEED][:], columns[schema.SUCCESS][:] = seed, True
    columns[schema.DONE][:, 0] = np.arange(length) == length - 1
    return Episode(seed, columns, True, True)


def make_policy(folder: Path, env: EnvConfig = ENV) -> Path:
    """A policy that acts, badly."""
    spec = env_spec(env)
    return write_checkpoint(folder, "act", spec, origin=Origin.of(spec, env_fingerprint(env)))


def mark(policy: Path, words: str) -> Path:
    """Make a policy another one, that acts the same."""
    edit_json(policy / META_FILE, lambda meta: meta.update(options={"mark": words}))
    return policy


def make_run(
    folder: Path,
    policy: Path,
    seed: int = 0,
    successes: tuple[float, ...] = SUCCESSES,
    labels: int = 100,
) -> Path:
    """A finished run of as many rounds as successes, each with a policy of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    settings = {"seed": seed, "rounds": len(successes) - 1}
    save_options(folder, replace(OPTIONS, settings=settings, output_dir=folder))
    for number, success in enumerate(successes):
        made = (
            folder / f"round_{number:03d}" / "policy" / "checkpoints" / "last" / "pretrained_model"
        )
        shutil.copytree(policy, made)
        mark(made, f"{folder} {number}")
        record = {
            "round": number,
            "labels": labels * (number + 1),
            "episodes": 2 * (number + 1),
            "beta": 0.0,
        }
        record |= {"validation_success": success, "validation_episodes": 10}
        make_eval(folder / f"round_{number:03d}" / "eval.json", [success > 0.5] * 2, seed=3_000_000)
        append_line(
            folder / "metrics.jsonl",
            record | {"seconds": {"collect": 1.0, "fit": labels / 100, "validate": 5.0}},
        )
    shutil.copytree(policy, folder / "best" / "pretrained_model")
    (folder / "report.html").write_text("")
    return folder


def make_eval(
    path: Path, outcomes: list[bool], seed: int = 4_000_000, horizon: int = 8, task: str = "reach"
) -> Path:
    """An evaluation with these outcomes."""
    episodes = tuple(EpisodeResult(seed + i, good, good, 8, 0.0) for i, good in enumerate(outcomes))
    settings = EvalSettings(horizon, ENV.tolerance, hold=HOLD)
    EvalResult(path.parent.name, "panda", task, env_fingerprint(ENV), episodes, settings).write(
        path
    )
    return path
