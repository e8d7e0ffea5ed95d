"""`manip-il robot check`: one page of what an arm can do."""

import json
from pathlib import Path

import numpy as np
import pytest

from manip_il.cli.main import main
from manip_il.errors import RenderError
from manip_il.evaluation import robot_check
from manip_il.robots import reach
from manip_il.robots.table import get_robot

from ..robots.own import model_of, tree_of, write
from .made_runs import run


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An arm of a user's own whose map is kept, as working it out takes long."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return with_map(write(tmp_path))


def with_map(path: Path) -> Path:
    place = reach._place(get_robot(path))
    place.parent.mkdir(parents=True, exist_ok=True)
    np.savez(place, origin=np.array([-1.0, -1.0, 0.0]), errors=np.zeros((41, 41, 21)))
    return path


@pytest.fixture
def no_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise RenderError("no off-screen OpenGL")

    monkeypatch.setattr(robot_check, "looks", refuse)


def test_without_opengl_the_page_says_so(own: Path, tmp_path: Path, no_opengl: None, capsys):
    out = tmp_path / "out"
    assert run(f"--quiet robot check {own} --tasks=reach --episodes=0 --output_dir={out}") == 0
    said = capsys.readouterr()
    assert "own has starts for 1 of 1 tasks; the expert was not run." in said.out
    page, found = (out / "report.html").read_text(), json.loads((out / "check.json").read_text())
    assert "No pictures: no off-screen OpenGL" in page
    facts = {"task": "reach", "done": True, "starts": 50, "refused": ""}
    assert found["tasks"] == [facts | {"clean": None, "noisy": None}]


def test_a_task_that_cannot_be_done_ends_with_1(own: Path, tmp_path: Path, no_opengl: None, capsys):
    tree = tree_of()
    tree["gripper"]["open"] = [0.02, 0.02]
    path, out = with_map(write(tmp_path, "narrow", tree=tree)), tmp_path / "out"
    words = (
        f"--quiet robot check {path} --tasks=reach,lift --episodes=0 --output_dir={out}"
    ).split()
    assert main(words) == 1
    said = capsys.readouterr()
    assert (
        "narrow has starts for 1 of 2 tasks; the expert was not run; it cannot do lift." in said.out
    )
    assert "change: lift: task lift: 'object' is 0.050 m wide" in said.out
    assert "cannot do 1 of 2 tasks: lift" in said.err
    assert (out / "report.html").is_file()


def test_parts_that_overlap_at_home_are_named_with_their_depth(
    own: Path, tmp_path: Path, no_opengl: None, capsys
):
    elbow = '<geom size="0.06" pos="0 0 0.3" mass="0.1"/><body name="wrist"'
    words = ["--quiet", "robot", "check", "--tasks=reach", "--episodes=0"]
    main([*words, str(own), f"--output_dir={tmp_path / 'apart'}"])
    assert "At home" not in capsys.readouterr().out
    thick = with_map(
        write(tmp_path, "thick", model=model_of().replace('<body name="wrist"', elbow))
    )
    main([*words, str(thick), f"--output_dir={tmp_path / 'overlap'}"])
    assert "fore and hand by 10.0 mm" in capsys.readouterr().out


@pytest.mark.gl
@pytest.mark.slow
def test_the_page_of_an_arm_has_pictures_and_episodes(own: Path, tmp_path: Path, capsys):
    out = tmp_path / "out"
    assert run(f"--quiet robot check {own} --tasks=reach --episodes=2 --output_dir={out}") == 0
    assert "| 50 of 50 | 100" in capsys.readouterr().out.replace("  ", " ")
    assert "The arm at home in its scene" in (out / "report.html").read_text()
    assert json.loads((out / "check.json").read_text())["tasks"][0]["clean"]["success_rate"] == 1
