"""`record`, `dagger` and `eval`, killed at any moment and again and again, lose what was in
progress and no more.
"""

import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import numpy as np
import pytest

from .child import living

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("MANIP_IL_KILLS", "3"))  # of each command
PATIENCE = 600.0  # for a command that is not killed, and for the end of one that is [s]
REACH = ("--robot.type=fetch", "--task.type=reach", "--env.horizon=60")
RECORD = ("record", *REACH, "--dataset.num_episodes=8", "--dataset.root={folder}/out/demos")
DAGGER = (
    *(
        "dagger",
        *REACH,
        "--rounds=1",
        "--demonstrations=3",
        "--episodes_per_round=4",
        "--steps=300",
    ),
    *("--policy.width=16", "--validation_episodes=4", "--workers=2", "--output_dir={folder}/out"),
)
EVAL = (
    *(
        "eval",
        *REACH,
        "--eval.n_episodes=16",
        "--eval.batch_size=2",
        "--eval.films=0",
        "--workers=2",
    ),
    "--output_dir={folder}/out",
)
UNEQUAL = ("config.yaml", "report.html")  # they name the folder, and when what happened
CLOCK = ("seconds", "samples_per_s", "update_s")


@dataclass
class Command:
    """A command whose words name a folder, `{folder}`; it is resumed from the second start on."""

    start: Callable[..., ForkServerProcess]
    words: tuple[str, ...]
    folder: Path

    def begin(self) -> ForkServerProcess:
        # also where the kill left nothing yet
        again = ("--resume=true",) if self.folder.is_dir() else ()
        self.folder.mkdir(exist_ok=True)
        words = [word.format(folder=self.folder) for word in self.words]
        return self.start(*words, *again, log=self.folder / "log", warm=True)

    def run(self) -> float:
        """Seconds that it takes when nobody kills it."""
        started = time.monotonic()
        process = self.begin()
        process.join(PATIENCE)
        assert process.exitcode == 0, (self.folder / "log").read_text()
        return time.monotonic() - started

    def kill(self, delay: float) -> bool:
        """Kill it after so many seconds, and see its workers end.

        Whether it was not done before.
        """
        process = self.begin()
        process.join(delay)
        if process.exitcode is not None:
            assert process.exitcode == 0, (self.folder / "log").read_text()
            return False
        assert process.pid is not None
        os.kill(process.pid, 9)
        deadline = time.monotonic() + PATIENCE
        while living(process.pid):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        process.join(PATIENCE)
        return True

    def made(self) -> dict[str, object]:
        """All that must be the same, however often it was killed."""
        out = self.folder / "out"
        files = {
            path.relative_to(out).as_posix(): path for path in out.rglob("*") if path.is_file()
        }
        return {name: _content(path) for name, path in files.items() if path.name not in UNEQUAL}

    def episodes(self) -> dict[str, bytes]:
        return {
            str(path.relative_to(self.folder)): path.read_bytes()
            for path in self.folder.rglob("episode-*.mcap")
        }


def _content(path: Path) -> object:
    """A file's bytes.

    Of a run's metrics all but the seconds, of finished episodes in whatever order they ended.
    """
    if path.name == "episodes.jsonl":
        return sorted(path.read_bytes().splitlines())
    if path.name != "metrics.jsonl":
        return path.read_bytes()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in CLOCK} for line in lines]


@pytest.fixture(scope="module")
def policy(start, tmp_path_factory) -> Path:
    dagger = Command(start, DAGGER, tmp_path_factory.mktemp("policy") / "run")
    dagger.run()
    return dagger.folder / "out" / "best" / "pretrained_model"


@pytest.mark.parametrize(
    "words",
    [
        pytest.param((*RECORD, "--workers=1"), id="record"),
        pytest.param((*RECORD, "--workers=2"), id="record with two workers"),
        pytest.param(DAGGER, id="dagger"),
        pytest.param(EVAL, id="eval"),
    ],
)
def test_a_killed_command_takes_its_processes_along_and_goes_on_to_equal_bytes(
    words, start, policy, tmp_path
):
    words = (*words, f"--policy.path={policy}") if words[0] == "eval" else words
    calm = Command(start, words, tmp_path / "calm")
    seconds = calm.run()
    expected, episodes = calm.made(), calm.episodes()
    rng, killed, chain = np.random.default_rng(len(words)), 0, 0
    while killed < KILLS:
        chain += 1
        again = Command(start, words, tmp_path / f"chain_{chain}")
        while killed < KILLS:
            before = again.episodes()
            was_killed = again.kill(rng.uniform(0, seconds))
            after = again.episodes()
            # finished ones stay, and are whole
            assert before.items() <= after.items() <= episodes.items()
            if not was_killed:
                seconds *= 0.7  # it is faster now
                break
            killed += 1
        again.run()
        assert again.made() == expected
        assert sorted(path.name for path in again.folder.iterdir()) == ["log", "out"]
