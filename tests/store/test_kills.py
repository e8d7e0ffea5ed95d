"""kill -9 at random moments, in either direction: readers see a whole version, and the next try
succeeds.
"""

import multiprocessing
import os
import time
from pathlib import Path

import numpy as np
import pytest

from manip_il.bridges.store.transfer import open_remote, pull, push

from .conftest import content, make_run
from .servers import talk_to

KILLS = int(os.environ.get("MANIP_IL_KILLS", "3"))  # of each push and pull


def work(do: str, url: str, folder: Path, environment: dict[str, str], begun: Path) -> None:
    """Push or pull, in a process that is killed."""
    os.environ |= environment
    if hub := environment.get("HUB_OF_THE_TEST"):
        talk_to(hub)
    remote = open_remote(url, quiet=True)
    begun.touch()
    push(folder, remote) if do == "push" else pull(remote, folder)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("do", "place"),
    [("push", "file"), ("push", "s3"), ("push", "sftp"), ("push", "hub"), ("pull", "file")],
    indirect=["place"],
)
def test_a_killed_transfer(do: str, place: str, request: pytest.FixtureRequest, tmp_path: Path):
    """A pull ends with one rename on this machine, wherever it came from."""
    if place.startswith("hf://"):
        os.environ["HUB_OF_THE_TEST"] = request.getfixturevalue("hub").url
    context, rng, killed = multiprocessing.get_context("forkserver"), np.random.default_rng(7), 0
    usual = 0.0
    runs = [make_run(tmp_path / f"run{seed}", seed, size=3_000_000) for seed in range(2)]
    for number in range(10 * KILLS):
        folder, begun = tmp_path / f"got{number}", tmp_path / f"begun{number}"
        source = runs[number % 2] if do == "push" else runs[0]
        if number < 2:
            start = time.monotonic()
            push(source, open_remote(place, quiet=True))
            usual = time.monotonic() - start
        words = (do, place, source if do == "push" else folder, dict(os.environ), begun)
        process = context.Process(target=work, args=words)
        process.start()
        while process.is_alive() and not begun.exists():
            time.sleep(0.002)
        time.sleep(float(rng.uniform(0, usual)))
        process.kill()
        process.join()
        if process.exitcode == -9:
            killed += 1
        else:  # it is faster now
            usual *= 0.7
        if do == "push":
            pull(open_remote(place, quiet=True), folder)
            assert content(folder) in [content(run) for run in runs]
            push(source, open_remote(place, quiet=True))
        if do == "push" or not folder.exists():
            pull(open_remote(place, quiet=True), folder, overwrite=True)
        assert content(folder) == content(source)
        assert not list(tmp_path.glob(f".got{number}*"))
        if killed == KILLS:
            return
    pytest.fail(f"{killed} processes were killed, {KILLS} expected")
