"""Datasets: built again from journals to the bytes that were recorded, and rendered again with
other pictures.
"""

import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from manip_il.cli.main import main
from manip_il.collect.job import RolloutJob
from manip_il.data.dataset import Dataset
from manip_il.data.journal import list_episodes
from manip_il.data.lerobot_write import write_dataset
from manip_il.sim import render
from manip_il.sim.config import Look
from manip_il.worlds.table import env_fingerprint, env_spec, make_config

from ..pictures import read_episodes
from .made_runs import files, run


def record(root: Path, *words: str) -> list[str]:
    return [
        *(
            f"record --robot.type=fetch --dataset.root={root} --dataset.num_episodes=3 --workers=1"
        ).split(),
        *words,
    ]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "demos"
    assert main(record(root, "--dataset.repo_id=me/demos")) == 0
    return root


def journals_of(root: Path) -> Path:
    return root.with_name(f"{root.name}.journals")


def test_resuming_what_never_began_begins(recorded, tmp_path, capsys):
    """So that one line serves a job that is queued again and again."""
    assert main(record(tmp_path / "demos", "--dataset.repo_id=me/demos", "--resume=true")) == 0
    assert files(tmp_path / "demos") == files(recorded)


def test_the_journals_give_the_datasets_bytes_again(recorded, tmp_path):
    assert run(f"data build {journals_of(recorded)} {tmp_path / 'again'}") == 0
    assert files(tmp_path / "again") == files(recorded)


def test_a_damaged_journal_is_named_and_its_seed_runs_again_once_it_is_deleted(
    recorded, tmp_path, capsys
):
    journals = tmp_path / "x.journals"
    shutil.copytree(journals_of(recorded), journals)
    cut = list_episodes(journals)[1]
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    assert run(f"data build {journals} {tmp_path / 'x'}") == 1
    assert f"error: {cut} is not a complete episode" in capsys.readouterr().err
    cut.unlink()
    assert (
        main(["record", *record(tmp_path / "x", "--dataset.repo_id=me/demos", "--resume=true")[1:]])
        == 0
    )
    assert files(tmp_path / "x") == files(recorded)


@pytest.mark.slow
@pytest.mark.gl
def test_pictures_are_recorded_and_built_again_to_the_same_bytes_by_one_worker_or_two(tmp_path):
    pictured = [
        "--cameras=front,wrist",
        "--image.height=64",
        "--image.width=80",
        "--task.type=reach",
    ]
    pictured += ["--dataset.rgb_encoder.crf=20"]
    assert main(record(tmp_path / "one", *pictured)) == 0
    assert '"video.crf": 20' in (tmp_path / "one/meta/info.json").read_text()
    assert main(record(tmp_path / "two", *pictured, "--workers=2")) == 0
    assert files(tmp_path / "one") == files(tmp_path / "two")
    assert run(f"data build {journals_of(tmp_path / 'one')} {tmp_path / 'again'}") == 0
    assert files(tmp_path / "again") == files(tmp_path / "one")
    frames = Dataset.open(tmp_path / "one").columns(["index"])["index"]
    episodes = list(read_episodes(tmp_path / "one"))
    for camera in ("front", "wrist"):
        decoded = np.concatenate(
            [episode.columns[f"observation.images.{camera}"] for episode in episodes]
        )
        assert decoded.shape == (len(frames), 64, 80, 3)
        assert len(np.unique(decoded)) > 50  # something is to be seen
    [video, _] = (tmp_path / "again").rglob("*.mp4")
    video.write_bytes(video.read_bytes()[:-1000])
    assert run(f"data check {tmp_path / 'again'}") == 1


ENV = make_config("panda", "reach", horizon=6, success_steps=1)


@pytest.fixture
def demos(here) -> Path:
    episodes = RolloutJob(ENV).run(range(3))
    write_dataset(episodes, Path("demos"), env_spec(ENV), fingerprint=env_fingerprint(ENV))
    return Path("demos")


@pytest.mark.gl
@pytest.mark.slow
def test_two_workers_write_the_bytes_of_one(demos):
    words = [
        "--cameras=wrist",
        "--image.height=32",
        "--image.width=32",
        "--look.shadows=true",
        "--look.light_turn=30",
    ]
    assert run("data render demos one --workers=1", *words) == 0
    Path("again").mkdir()
    assert run("data render demos again/one --workers=2", *words) == 0
    assert files(Path("one")) == files(Path("again/one"))
    assert Dataset.open(Path("one")).provenance["rendered"]["cameras"]["look"] == asdict(
        Look(shadows=True, light_turn=30)
    )


def test_without_opengl_what_was_there_stays(demos, error, monkeypatch):
    def broken(*_: object) -> None:
        raise ImportError("cannot load libEGL.so.1")

    render.close()
    monkeypatch.setattr("mujoco.egl.GLContext", broken)
    shutil.copytree("demos", "x")
    before = files(Path())
    assert run("data render demos x --workers=1 --overwrite=true --quiet") == 1
    assert "no off-screen OpenGL (ImportError: cannot load libEGL.so.1); " in error()
    assert files(Path()) == before
