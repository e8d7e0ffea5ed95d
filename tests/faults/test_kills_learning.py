"""`eval` and `dagger` with workers, killed again and again: nothing lives on, and what is resumed has equal bytes."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from .killed import Command

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("MANIP_IL_KILLS", "2"))  # of each command
SIZES = ("--robot.type=fetch", "--task.type=reach", "--env.horizon=60", "--workers=2")
DAGGER = (
    *("dagger", *SIZES, "--rounds=1", "--demonstrations=3", "--episodes_per_round=4", "--steps=300"),
    *("--policy.width=16", "--validation_episodes=4"),
)
EVAL = ("eval", *SIZES, "--eval.n_episodes=16", "--eval.batch_size=2", "--eval.films=0")
UNEQUAL = ("log", "config.yaml", "report.html")  # they name the folder, and when what happened
CLOCK = ("seconds", "samples_per_s", "data_share")


@pytest.fixture(scope="module")
def calm(start, tmp_path_factory) -> Callable[..., Command]:
    """A command that nobody kills."""
    done: dict[tuple[str, ...], Command] = {}

    def run(*words: str) -> Command:
        if words not in done:
            done[words] = learner(start, words, tmp_path_factory.mktemp("calm") / "run")
            done[words].run()
        return done[words]

    return run


def learner(start, words: tuple[str, ...], folder: Path) -> Command:
    return Command(start, (*words, "--output_dir={folder}/out"), folder, kept=folder / "out", warm=True)


def made(command: Command) -> dict[str, object]:
    """All that must be the same, however often it was killed."""
    files = {path.relative_to(command.kept).as_posix(): path for path in command.kept.rglob("*") if path.is_file()}
    return {name: _content(path) for name, path in files.items() if path.name not in UNEQUAL}


@pytest.mark.parametrize("name", ["eval", "dagger"])
def test_a_killed_command_takes_its_processes_along_and_goes_on_to_equal_bytes(name, start, calm, tmp_path):
    words = DAGGER
    if name == "eval":
        words = (*EVAL, f"--policy.path={calm(*DAGGER).kept}/best/pretrained_model")
    expected = made(calm(*words))
    seconds = learner(start, words, tmp_path / "timed").run()  # the first had paid for what is loaded once
    rng = np.random.default_rng(len(name))
    ends: list[float] = []
    chain = 0
    while len(ends) < KILLS:
        chain += 1
        again = learner(start, words, tmp_path / f"chain_{chain}")
        while len(ends) < KILLS:
            if (end := again.kill(rng.uniform(0, seconds))) is None:
                break
            ends.append(end)
        else:
            again.run()
        assert made(again) == expected
        assert sorted(path.name for path in again.folder.iterdir()) == ["log", "out"]
    print(f"{name}: {KILLS} kills in {chain} runs, the last process gone after {max(ends):.2f} s at most")


def _content(path: Path) -> object:
    """A file's bytes; of a run's metrics all but the seconds, of finished episodes in whatever order they ended."""
    if path.name == "episodes.jsonl":
        return sorted(path.read_bytes().splitlines())
    if path.name != "metrics.jsonl":
        return path.read_bytes()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in CLOCK} for line in lines]
