"""`manip-il doctor`: one line a finding, a verdict, an exit code."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from manip_il.cli.main import main
from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.data import lerobot_layout as layout
from manip_il.data.build import build
from manip_il.data.journal import Journal
from manip_il.sim.env import EnvConfig

from ..damage import edit_json
from .made_runs import make_episode

ENV = EnvConfig("panda", "reach", 20)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for seed in (1, 2):
        Journal(tmp_path / "d.journals", env_spec(ENV), env_fingerprint(ENV)).write(
            make_episode(env_spec(ENV), seed, 6)
        )
    build(tmp_path / "d.journals", tmp_path / "d")
    return tmp_path / "d"


def test_a_whole_dataset_exits_0_with_one_line(root, capsys):
    assert main(["doctor", str(root)]) == 0
    assert capsys.readouterr().out == f"{root}: 2 episodes, 12 frames: whole\n"


def test_an_error_exits_1_and_a_warning_0(root, capsys, monkeypatch):
    (root / "images").mkdir()
    (root / "images" / "x.png").write_bytes(b"x")
    assert main(["doctor", str(root)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{root}: 2 episodes, 12 frames: whole, 1 warning"
    shutil.rmtree(root / "images")
    (root / layout.TASKS).unlink()
    for folder in (str(root), "."):  # the current folder is a name, too
        monkeypatch.chdir(root)
        assert main(["doctor", folder, "--quiet"]) == 1
        captured = capsys.readouterr()
        assert captured.out == "error    meta/tasks.parquet: is missing: no row's task has a name\n"
        assert captured.err == f"manip-il: error: {root}: 1 error\n"


def test_repair_builds_again_and_exits_0(root, capsys):
    (root / layout.TASKS).unlink()
    assert main(["doctor", str(root), "--repair=true"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[1] == f"repair   built again from d.journals: 2 episodes; what was there is kept in {root}.before-repair"
    assert out[-1] == f"{root}: 2 episodes, 12 frames: whole"


def test_repair_of_what_is_whole_changes_nothing(root, capsys):
    before = {path: path.stat().st_mtime_ns for path in root.parent.rglob("*")}
    assert main(["doctor", str(root), "--repair"]) == 0
    assert "nothing to repair" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in root.parent.rglob("*")} == before


def test_what_stays_wrong_exits_1(root, capsys):
    root.with_name("d.journals").rename(root.with_name("elsewhere"))
    (root / layout.TASKS).unlink()
    assert main(["doctor", str(root), "--repair=true"]) == 1
    assert "not repaired, as there are no journals in d.journals to build it from" in capsys.readouterr().out


def test_the_robots_joints_are_compared(root, capsys):
    edit_json(root / layout.OURS, lambda ours: ours["spec"]["joint_names"].__setitem__(0, "elbow"))
    edit_json(root / layout.OURS, lambda ours: ours["fingerprint"].update(model_sha256="0" * 64))
    assert main(["doctor", str(root)]) == 1
    out = capsys.readouterr().out
    assert "error    meta/manip_il.json: joint_names is elbow, " in out
    assert "warning  meta/manip_il.json: compiled MuJoCo model differs: the dataset has 000000000000..." in out


def test_a_robot_of_the_users_own_is_no_finding(root, capsys):
    edit_json(root / layout.OURS, lambda ours: ours["spec"].update(robot="so100"))
    edit_json(root / layout.INFO, lambda info: info.update(robot_type="so100"))
    assert main(["doctor", str(root)]) == 0
    assert "warning" not in capsys.readouterr().out
