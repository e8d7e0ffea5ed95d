from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from manip_il.cli.main import main
from manip_il.data.lerobot_io import read_provenance, read_spec, read_table, write_dataset
from manip_il.engine.describe import env_fingerprint, env_spec
from manip_il.engine.jobs import RolloutJob, run_job
from manip_il.sim import render
from manip_il.sim.env import EnvConfig
from manip_il.sim.look import CameraConfig, Look

ENV = EnvConfig("panda", "reach", horizon=6, success_steps=1)


@pytest.fixture
def demos(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    episodes = run_job(RolloutJob(ENV, "expert"), range(3))
    write_dataset(episodes, Path("demos"), env_spec(ENV), repo_id="local/demos", fingerprint=env_fingerprint(ENV))
    return Path("demos")


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.mark.gl
@pytest.mark.slow
def test_the_command_makes_a_dataset_with_the_asked_pictures(demos, capsys):
    assert main(["render", "demos", "seen", "--workers=1", "--image.height=48", "--image.width=64"]) == 0
    said = capsys.readouterr()
    assert "rendered 3 episodes, 18 frames: front, wrist, 48 x 64 pixels\ndataset: seen\n" in said.out
    assert "render demos: 3/3" in said.err
    assert read_spec(Path("seen")) == env_spec(ENV, CameraConfig(("front", "wrist"), 48, 64))
    np.testing.assert_array_equal(read_table(Path("seen"))["sim_state"], read_table(demos)["sim_state"])


@pytest.mark.gl
@pytest.mark.slow
def test_two_workers_write_the_bytes_of_one(demos):
    words = ["--cameras=wrist", "--image.height=32", "--image.width=32", "--look.shadows=true", "--look.light_turn=30"]
    assert main(["render", "demos", "one", "--workers=1", *words]) == 0
    Path("again").mkdir()
    assert main(["render", "demos", "again/one", "--workers=2", *words]) == 0
    assert files(Path("one")) == files(Path("again/one"))
    assert read_provenance(Path("one"))["rendered"]["cameras"]["look"] == asdict(Look(shadows=True, light_turn=30))


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["demos"], 2, "TARGET is missing"),
        (["demos", "x", "--cameras=frnt"], 2, "unknown camera 'frnt' (did you mean 'front'?)"),
        (["demos", "x", "--cameras="], 2, "--cameras names none; expected front, wrist or both"),
        (["demos", "x", "--image.height=127"], 2, "pictures of height 127 and width 128; expected even numbers"),
        (["demos", "x", "--look.brightness=9"], 2, "brightness is 9.0; expected a factor from 0.1 to 2.0"),
        (["demos", "x", "--workers=0"], 2, "--workers is 0; expected at least 1"),
        (["demos", "demos", "--overwrite=true"], 2, "TARGET demos overlaps SOURCE demos"),
        (["demos", ".", "--overwrite=true"], 2, "overlaps SOURCE demos"),
        (["demos", "demos/meta", "--overwrite=true"], 2, "overlaps SOURCE demos"),
        (["demos", "full"], 2, "full exists already; replace it with --overwrite=true"),
        (["demos", "full", "--overwrite=true"], 2, "full holds something that manip-il did not make"),
        (["nothing", "x"], 2, "nothing does not exist; expected the folder of a LeRobot dataset"),
    ],
)
def test_wrong_words_are_answered_with_one_line_and_nothing_changes(demos, capsys, words, code, message):
    Path("full").mkdir()
    Path("full/thesis.txt").touch()
    before = files(Path())
    assert main(["render", *words]) == code
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 1
    assert message in errors[0]
    assert files(Path()) == before


@pytest.fixture
def no_opengl(monkeypatch):
    def broken(*_: object) -> None:
        raise ImportError("cannot load libEGL.so.1")

    render.close()
    monkeypatch.setattr("mujoco.gl_context.GLContext", broken)


@pytest.mark.usefixtures("no_opengl")
def test_without_opengl_what_was_there_stays(demos, capsys):
    shutil.copytree("demos", "x")
    before = files(Path())
    assert main(["render", "demos", "x", "--workers=1", "--overwrite=true", "--quiet"]) == 1
    assert "no off-screen OpenGL (ImportError: cannot load libEGL.so.1); on Debian: apt" in capsys.readouterr().err
    assert files(Path()) == before
