"""A disk that fills up ends a command with one clear line, and nothing that was finished is
lost.
"""

from collections.abc import Callable
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

SCENE = ("--robot.type=fetch", "--task.type=reach")
RECORD = ("record", *SCENE, "--dataset.num_episodes=4", "--dataset.root={}/demos", "--workers=2")
DAGGER = (
    *(
        "dagger",
        *SCENE,
        "--rounds=1",
        "--demonstrations=2",
        "--episodes_per_round=2",
        "--validation_episodes=1",
    ),
    *("--workers=1", "--steps=4", "--policy.width=64", "--output_dir={}/out"),
)
Run = Callable[..., tuple[int | None, str]]


@pytest.fixture
def run(start: Callable[..., ForkServerProcess]) -> Run:
    """Runs a command in a folder.

    Returns its exit code and what it and those before it said there.
    """

    def run(folder: Path, *words: str, **options: int) -> tuple[int | None, str]:
        folder.mkdir(exist_ok=True)
        process = start(
            *(word.format(folder) for word in words), log=folder / "log", warm=True, **options
        )
        process.join()
        return process.exitcode, (folder / "log").read_text()

    return run


def episodes(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("episode-*.mcap")
    }


@pytest.mark.parametrize(
    ("words", "size"), [(RECORD, 0), (DAGGER, 130_000)], ids=["record", "dagger"]
)
def test_a_full_disk_ends_a_command_and_keeps_what_was_finished(
    words: tuple[str, ...], size: int, run: Run, tmp_path: Path
):
    calm, full = tmp_path / "calm", tmp_path / "full"
    assert run(calm, *words)[0] == 0
    expected = episodes(calm)
    sizes = sorted(map(len, expected.values()))
    code, said = run(full, *words, largest_file=size or (sizes[0] + sizes[-1]) // 2)
    assert code == 1
    [error] = [line for line in said.splitlines() if line.startswith("manip-il: error:")]
    assert "Traceback" not in said
    assert "File too large" in error
    assert f"cannot write {full}/" in error
    assert "--resume=true" in error
    assert episodes(full).items() <= expected.items()
    assert run(full, *words, "--resume=true")[0] == 0
    assert episodes(full) == expected
    # a worker that was killed while it wrote leaves a part, which resuming removes
    assert not [*full.rglob("*.partial"), *full.rglob("*.tmp")]
